"""The methods that are compared: trained models, and the two baselines without a network."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from cvthead.camera import Camera, Crop
from cvthead.coefficients import Coefficients
from cvthead.crop import head_crop
from cvthead.deformation import Deformation, DeformationModel
from cvthead.driving import at_neck, drive
from cvthead.evaluation.baselines import ColouredMesh
from cvthead.evaluation.metrics import Picture, on_white
from cvthead.evaluation.shots import Image, Shot, rotation
from cvthead.frame import Frame
from cvthead.head.model import HeadModel
from cvthead.official.painted import HARD_MASK, Painted
from cvthead.official.pipeline import OfficialPipeline
from cvthead.preset import Preset
from cvthead.tracking.tracker import FaceTurnedWarning, TrackedFace

COPY, MESH, BALD = "copy source", "coloured mesh", "coloured mesh, bald"


@dataclass(frozen=True, eq=False)
class Drawn:
    """A result before compositing: RGB (S, S, 3) uint8 and its own matte (S, S) in 0..1."""

    rgb: Image
    alpha: Picture

    @classmethod
    def of(cls, frame: Frame) -> Drawn:
        """What a pipeline rendered."""
        return cls(frame.rgb, frame.alpha.astype(np.float32) / np.float32(255))

    @property
    def on_white(self) -> Image:
        """(S, S, 3) uint8, composited by its own matte."""
        return (on_white(self.rgb, self.alpha) * 255).round().astype(np.uint8)


Draw = Callable[[Coefficients, Camera], Drawn]
"""Renders one person with coefficients and a camera in a crop's normalised coordinates."""


@dataclass(frozen=True, eq=False)
class Person:
    """One source picture as one method has prepared it.

    Attributes:
        coefficients: of the source, in the method's own head model.
        camera: of the source in its crop.
        preset: "open" or "official"; tells how a driver's pose is taken over.
        head: the method's head model.
        draw: renders this person.
        read: the face of a driver in the method's own coefficients.
    """

    coefficients: Coefficients
    camera: Camera
    preset: str
    head: HeadModel
    draw: Draw
    read: Callable[[Shot], TrackedFace]

    def asked(self, driver: Shot, crop: Crop | None = None) -> tuple[Coefficients, Camera]:
        """What a driver makes this person do, seen in a crop of the driver's picture (its head
        crop if None)."""
        return drive(self.head, self, self.read(driver), crop=crop or driver.head.crop)

    def follow(self, driver: Shot) -> Drawn:
        """This person as the driver, in the driver's head crop."""
        return self.draw(*self.asked(driver))

    def turned(self, yaw: float) -> Drawn:
        """The source's own face with the head turned on by ``yaw`` degrees about the vertical,
        in its own head crop."""
        about = cv2.Rodrigues(np.array([0.0, np.radians(yaw), 0.0]))[0]
        turn = cv2.Rodrigues(about @ rotation(self.coefficients))[0].ravel()
        wanted = self.coefficients.with_joints({"global": turn, "neck": np.zeros(3)})
        camera = self.camera.in_crop(head_crop(self.head, wanted, self.camera))
        if self.preset == "open":
            wanted, camera = at_neck(self.head, self.coefficients, wanted, camera)
        return self.draw(wanted, camera)


Method = Callable[[Shot], Person]
"""Prepares the person of a source picture."""


def trained(pipeline: Preset[Any], *, deform: bool = True) -> Method:
    """A preset's networks; without ``deform`` hair and shoulders are left out. Results of the
    official preset are cut out by the hard mask, as the released evaluation does."""

    def read(driver: Shot) -> TrackedFace:
        if pipeline.preset == "open":
            return driver.face
        return pipeline.tracker.track(driver.image)

    def prepare(source: Shot) -> Person:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FaceTurnedWarning)  # big poses are wanted here
            avatar = pipeline.encode(source.image, deform=deform)

        def draw(coefficients: Coefficients, camera: Camera) -> Drawn:
            if isinstance(pipeline, OfficialPipeline):
                points = pipeline.pose(avatar, coefficients, camera)
                return hard_masked(pipeline.paint(avatar, points))
            frame = pipeline.render_coefficients(avatar, coefficients, camera)
            return Drawn.of(frame)

        return Person(
            avatar.coefficients, avatar.camera, pipeline.preset, pipeline.head, draw, read
        )

    return prepare


def hard_masked(painted: Painted) -> Drawn:
    """What the official U-Net painted, its matte 0 or 1."""
    return Drawn(painted.frame().rgb, (painted.mask() > HARD_MASK).astype(np.float32))


def baselines(deformer: DeformationModel) -> dict[str, Method]:
    """Copying the source; a mesh with the source's colours, with and without hair and
    shoulders."""

    def copy(source: Shot) -> Person:
        drawn = Drawn(source.head.image, source.head.mask)
        return _untrained(deformer.head, source, lambda coefficients, camera: drawn)

    def mesh(source: Shot) -> Person:
        return _untrained(deformer.head, source, mesh_draw(coloured_mesh(deformer, source)))

    def bald(source: Shot) -> Person:
        mesh = coloured_mesh(deformer, source, bald=True)
        return _untrained(deformer.head, source, mesh_draw(mesh))

    return {COPY: copy, MESH: mesh, BALD: bald}


def _untrained(head: HeadModel, source: Shot, draw: Draw) -> Person:
    place = source.head.coefficients, source.head.camera
    return Person(*place, "open", head, draw, lambda driver: driver.face)


def coloured_mesh(deformer: DeformationModel, source: Shot, *, bald: bool = False) -> ColouredMesh:
    """The deformed mesh of a source with its colours; ``bald`` leaves out hair and shoulders."""
    head = source.head
    person = (head.mask > 0.5) & head.valid
    deformation = (
        Deformation.none(deformer.head)
        if bald
        else deformer.fit(head.coefficients, head.camera, person, head.valid)
    )
    return ColouredMesh.from_picture(
        deformer.head, head.coefficients, head.camera, deformation, head.image, person
    )


def mesh_draw(mesh: ColouredMesh) -> Draw:
    def draw(coefficients: Coefficients, camera: Camera) -> Drawn:
        rgb, alpha = mesh.render(coefficients, camera)
        return Drawn((rgb * 255).round().astype(np.uint8), alpha)

    return draw
