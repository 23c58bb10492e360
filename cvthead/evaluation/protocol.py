"""Self-reenactment of one clip: the first frame is the source, later frames drive.

The source's shape with each driver's expression, pose and camera, in the driver's own head crop
(paper section 4.2). Results are scored against the driving frame itself.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.deformation import Deformation, DeformationModel
from cvthead.driving import at_neck
from cvthead.errors import FaceError
from cvthead.evaluation.baselines import ColouredMesh
from cvthead.evaluation.metrics import Metrics, Picture, Score, on_white
from cvthead.evaluation.motion import Motion, motion_of
from cvthead.source import HeadCrop, cut_head
from cvthead.tracking.tracker import FaceTurnedWarning, TrackedFace, Tracker
from cvthead.video import read_frames

Image = NDArray[np.uint8]

OURS, COPY, MESH, BALD = "CVTHead", "copy source", "coloured mesh", "coloured mesh, bald"
METHODS = (OURS, COPY, MESH, BALD)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A result before compositing: RGB (S, S, 3) uint8 and its own matte (S, S) in 0..1."""

    rgb: Image
    alpha: Picture


Draw = Callable[[Coefficients, Camera], Drawn]
"""Renders one person with coefficients and a camera in a crop's normalised coordinates."""

Animate = Callable[[Image, HeadCrop], Draw]
"""Prepares a person from the whole source picture and its head crop."""


@dataclass(frozen=True, eq=False)
class Reenactment:
    """One driving frame.

    Attributes:
        frame: number in the clip.
        target: the driver's head crop.
        drawn: result of each method.
        scores: both pictures composited by the target's mask.
        own_matte: the same with each result composited by its own mask.
        wanted, got: what the driver does and what is tracked in our result; None if no face is
            found in it.
    """

    frame: int
    target: HeadCrop
    drawn: Mapping[str, Drawn]
    scores: Mapping[str, Score]
    own_matte: Mapping[str, Score]
    wanted: Motion
    got: Motion | None


@dataclass(frozen=True, eq=False)
class Clip:
    """Results of one clip; ``draw`` renders this person with any coefficients."""

    name: str
    source: HeadCrop
    drivers: list[Reenactment]
    draw: Draw


@dataclass(frozen=True, eq=False)
class Evaluator:
    """What all clips share. ``animate`` is the method under test."""

    tracker: Tracker
    deformer: DeformationModel
    metrics: Metrics
    animate: Animate

    def clip(self, path: Path, drivers: int) -> Clip | None:
        """Reenact the evenly spaced ``drivers`` frames of a clip.

        Returns:
            None if no frame, or none but the source, can be tracked.

        Raises:
            VideoError: the file cannot be read.
        """
        frames = [frame.rgb for frame in read_frames(path)]
        found = self.first_trackable(frames)
        if found is None:
            return None
        start, face = found
        source = cut_head(self.tracker, frames[start], face)
        draws = {
            OURS: self.animate(frames[start], source),
            COPY: copy_source(source),
            MESH: coloured_mesh(self.deformer, source, bald=False),
            BALD: coloured_mesh(self.deformer, source, bald=True),
        }
        numbers = np.unique(np.linspace(start, len(frames) - 1, drivers + 1).round().astype(int))
        results = []
        for number in numbers[1:].tolist():
            driver = self.track(frames[number], face)
            if driver is not None:
                results.append(self.reenact(number, frames[number], driver, draws, face))
        return Clip(path.stem, source, results, draws[OURS]) if results else None

    def first_trackable(self, frames: list[Image]) -> tuple[int, TrackedFace] | None:
        for number, frame in enumerate(frames):
            face = self.track(frame, None)
            if face is not None:
                return number, face
        return None

    def track(self, image: Image, source: TrackedFace | None) -> TrackedFace | None:
        """The largest face, with the source's shape if given; None if it cannot be tracked."""
        shape = source.coefficients.shape if source else None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FaceTurnedWarning)
            try:
                return self.tracker.track(image, shape=shape)
            except FaceError:
                return None

    def reenact(
        self,
        number: int,
        image: Image,
        driver: TrackedFace,
        draws: Mapping[str, Draw],
        source: TrackedFace,
    ) -> Reenactment:
        target = cut_head(self.tracker, image, driver)
        posed = at_neck(self.tracker.head, source.coefficients, target.coefficients, target.camera)
        drawn = {name: draw(*posed) for name, draw in draws.items()}
        wanted = on_white(target.image, target.mask)
        pictures = [on_white(result.rgb, target.mask) for result in drawn.values()]
        mattes = [on_white(result.rgb, result.alpha) for result in drawn.values()]
        scores = self.metrics.scores(pictures + mattes, wanted, target.mask, target.valid)
        result = drawn[OURS]
        shown = (on_white(result.rgb, result.alpha) * 255).round().astype(np.uint8)
        tracked = self.track(shown, source)
        networks = self.tracker.networks
        return Reenactment(
            number,
            target,
            drawn,
            dict(zip(drawn, scores, strict=False)),
            dict(zip(drawn, scores[len(drawn) :], strict=True)),
            motion_of(driver, networks),
            motion_of(tracked, networks) if tracked else None,
        )


def copy_source(source: HeadCrop) -> Draw:
    """The baseline that ignores the driver."""
    drawn = Drawn(source.image, source.mask)
    return lambda coefficients, camera: drawn


def coloured_mesh(deformer: DeformationModel, source: HeadCrop, *, bald: bool) -> Draw:
    """The baseline without a network; ``bald`` leaves out hair and shoulders."""
    person = (source.mask > 0.5) & source.valid
    deformation = (
        Deformation.none(deformer.head)
        if bald
        else deformer.fit(source.coefficients, source.camera, person, source.valid)
    )
    mesh = ColouredMesh.from_picture(
        deformer.head, source.coefficients, source.camera, deformation, source.image, person
    )

    def draw(coefficients: Coefficients, camera: Camera) -> Drawn:
        rgb, alpha = mesh.render(coefficients, camera)
        return Drawn((rgb * 255).round().astype(np.uint8), alpha)

    return draw
