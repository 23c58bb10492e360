"""Training samples: one source, a few driven views of the same person.

A clip's views are other frames of it. A still's views are itself and its mirror image: the
mirrored face, seen from the other side, is what the hidden half should look like. Instead of itself
it often shows what its points alone say of a view far away (cvthead/training/imagined.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from cvthead.clear import clear_points
from cvthead.deformation import MAX_SHELL_POINTS, Deformation
from cvthead.driving import at_neck
from cvthead.head.model import HeadModel
from cvthead.hidden import hidden_colours
from cvthead.model.config import OPEN
from cvthead.points import FAR_AWAY, SEEN, PointLayout
from cvthead.runtime.face import splatted
from cvthead.runtime.ghosts import point_owners
from cvthead.runtime.place import Placed, place
from cvthead.runtime.seams import outline_rim
from cvthead.source import (
    as_network_input,
    driven_points,
    network_input,
    places,
    portrait_pixels,
)
from cvthead.training.augmentation import UNCHANGED, colour_jitter, degraded, jittered
from cvthead.training.details import ZOOMED, detail_weights, unseen_weights, zoom_corner
from cvthead.training.imagined import imagined, turned
from cvthead.training.records import Frame, open_records
from cvthead.training.sampling import group_shares, turned_still
from cvthead.visibility import inside_mask, on_person

Array = NDArray[np.float32]

VIEWS = 2
CLIP_SHARE = 0.6
IMAGINED_SHARE = 0.6  # of the stills
CANDIDATES = 3  # frames drawn per view of a clip; the one that differs most from the source stays


@dataclass(frozen=True, eq=False)
class View:
    """A driven view: image (S, S, 3) 0..1, mask, valid (S, S) and points (P, 3).

    Shell points have no counterpart across the face. In the mirror image of the source they lie
    where the source shows something else, so nothing is carried there.
    """

    image: Array
    mask: Array
    valid: Array
    points: Array
    carries_shell: bool = True


class PairDataset(Dataset[dict[str, Tensor]]):
    """Sample ``i`` depends on ``seed`` and ``i`` alone, so a run resumes exactly."""

    def __init__(
        self,
        folder: Path,
        head: HeadModel,
        layout: PointLayout,
        *,
        size: int,
        seed: int,
        samples: int,
        deform: bool = True,
        all_seen: bool = False,
        augment: bool = True,
        labels: Path | None = None,
        whole: bool = False,
    ) -> None:
        """Args:
        folder: records of cvthead.data, see cvthead.training.records.
        size: of the driven views, pixels.
        samples: length.
        deform: False leaves the heads bald: the ablation without deformation.
        all_seen: True takes every point as seen by the source, as cvthead.source.read_source.
        augment: False takes pictures as they are, neither mirrored nor as
            cvthead.training.augmentation changes them.
        labels: table of the stills' groups, see cvthead.training.sampling.
        whole: True draws the points that the portrait cuts off as well, as the paper does.

        Raises:
            InputError: no records in the folder, those of the preset official, or no table of
                labels.
        """
        self.deform, self.augment, self.whole = deform, augment, whole
        self.all_seen = all_seen
        self.head, self.layout = head, layout
        self.size, self.seed, self.samples = size, seed, samples
        stored = open_records(folder)
        self.clips = [record for record in stored if record.frames > 1]
        self.stills = [record for record in stored if record.frames == 1]
        self.shares = group_shares(self.stills, labels)

    def __len__(self) -> int:
        return self.samples

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        cv2.setNumThreads(1)
        rng = np.random.default_rng((self.seed, index))
        use_clip = bool(self.clips) and (not self.stills or rng.random() < CLIP_SHARE)
        record = (
            self.clips[int(rng.integers(len(self.clips)))].open()
            if use_clip
            else turned_still(rng, self.stills, self.shares)
        )
        number = int(rng.choice(record.sources))
        source = record.frame(number)
        deformation = record.deformation(number) if self.deform else Deformation.none(self.head)
        visible = record.visible(number, self.layout.total).astype(np.float32)
        anchor = np.zeros(MAX_SHELL_POINTS, dtype=np.int64)
        anchor[: len(deformation.shell_anchor)] = deformation.shell_anchor

        def points(frame: Frame) -> Array:
            posed = replace(frame.coefficients, shape=source.coefficients.shape)
            posed, camera = at_neck(self.head, source.coefficients, posed, frame.camera)
            return driven_points(self.head, self.layout, posed, deformation, camera)

        own = points(source)
        if record.frames > 1:
            views = []
            for drawn in rng.integers(record.frames, size=(VIEWS, CANDIDATES)):
                far = max(drawn.tolist(), key=lambda other: record.motion(number, other))
                frame = record.frame(far)
                views.append(as_view(frame, points(frame)))
        else:
            view = as_view(source, own)
            views = [view, replace(mirrored(view, self.layout), carries_shell=False)]
            # Nothing is imagined for the paper's network, whose points go on where the portrait
            # ends.
            if self.augment and not self.whole and rng.random() < IMAGINED_SHARE:
                hair = record.deformation(number)
                views[0] = self._imagined(rng, source, visible > 0, hair, deformation)
        colours = colour_jitter(rng) if self.augment else UNCHANGED
        image, mask = source.image, source.mask
        if self.augment:
            image, mask, own = jittered(rng, source, own)
        image = np.round(
            np.clip(colours(image.astype(np.float32) / np.float32(255)), 0, 1) * 255
        ).astype(np.uint8)
        if self.augment:
            image = degraded(rng, image)
        views = [replace(v, image=np.clip(colours(v.image), 0, 1)) for v in views]
        network = network_input(image, mask)
        visible *= inside_mask(own, mask)
        drawn = on_person(own, mask)
        if self.augment and rng.random() < 0.5:  # the whole sample seen in a mirror
            network = network[:, :, ::-1]
            own, visible = flip_points(own, self.layout), flip_order(visible, self.layout)
            drawn = flip_order(drawn.astype(np.float32), self.layout) > 0
            anchor = self.head.mirror[anchor].astype(np.int64)
            views = [mirrored(v, self.layout) for v in views]
        if self.whole:
            drawn = np.ones_like(drawn)
        driven = [np.where(drawn[:, None], v.points, FAR_AWAY) for v in views]
        landmarks = [self.head.landmarks(v.points[: self.layout.vertices]) for v in views]
        portrait = portrait_pixels(network)
        rim = outline_rim(portrait)
        zoomed = int(rng.integers(len(ZOOMED)))

        def carried() -> tuple[list[Array], list[Placed]]:
            at = places(self.layout, own, visible > 0)
            ats = [at if v.carries_shell else without_shell(at, self.layout) for v in views]
            return ats, [
                self._placed(d, its, rim, portrait) for d, its in zip(driven, ats, strict=True)
            ]

        ats, placed = carried()
        weights = [
            np.maximum(detail_weights(marks, self.size), unseen_weights(each))[None]
            for marks, each in zip(landmarks, placed, strict=True)
        ]
        clear = clear_points(self.layout, network, own, visible > 0)
        hidden = hidden_colours(self.layout, network, own, clear)
        if self.all_seen:
            visible, clear = np.ones_like(visible), np.ones_like(clear)
            ats, placed = carried()
        stack: dict[str, NDArray[Any]] = {
            "source": network,
            "points": own,
            "clear": clear,
            "seen": np.stack([each[:, 2] for each in ats]),
            "anchor": anchor,
            "hidden": hidden,
            "window": rng.random(3),
            "zoom": np.array([zoom_corner(each, zoomed, self.size) for each in landmarks]),
            "weight": np.stack(weights),
            "background": np.full((VIEWS, 3, 1, 1), 1, np.float32) * rng.random((1, 3, 1, 1)),
            "driven": np.stack(driven),
            "warped": np.stack([as_network_input(each.warped) for each in placed]),
            **targets(views, self.size),
        }
        if not self.whole:
            stack["splatted"] = np.stack([splatted(self.layout, d, self.size) for d in driven])
        return {
            name: torch.from_numpy(
                np.ascontiguousarray(value if name == "anchor" else value.astype(np.float32))
            )
            for name, value in stack.items()
        }

    def _imagined(
        self,
        rng: np.random.Generator,
        source: Frame,
        visible: NDArray[np.bool_],
        hair: Deformation,
        deformation: Deformation,
    ) -> View:
        """The source turned far, by what its points show: those of the head with its hair, also
        where ``deformation`` leaves it bald."""
        posed, camera = turned(rng, self.head, source.coefficients, source.camera)
        start = source.coefficients, hair, source.camera
        own, far, driven = (
            driven_points(self.head, self.layout, *each)
            for each in (start, (posed, hair, camera), (posed, deformation, camera))
        )
        far = np.where(on_person(own, source.mask)[:, None], far, FAR_AWAY)
        shown = visible & inside_mask(own, source.mask)
        image, mask = imagined(self.layout, source.image, source.mask, own, shown, far, self.size)
        return View(image, mask, np.ones_like(mask), driven)

    def _placed(self, driven: Array, at: Array, rim: Array, portrait: NDArray[np.uint8]) -> Placed:
        """The portrait carried to the driven points."""
        splat_size = self.size // OPEN.unet_unshuffle
        nothing = np.empty((len(driven), 0), np.uint8)
        owners = point_owners(at, at[:, 2] == SEEN)
        return place(self.layout, driven, at, owners, rim, nothing, portrait, splat_size)


def targets(views: Sequence[View], size: int) -> dict[str, Array]:
    """What rendered views of this size are compared with: image (v, 3, s, s) in 0..1, mask and
    valid (v, 1, s, s)."""

    def stacked(images: Iterable[Array]) -> Array:
        sized = (resized(image, size).reshape(size, size, -1) for image in images)
        return np.stack([image.transpose(2, 0, 1) for image in sized])

    return {
        "image": stacked(view.image for view in views),
        "mask": stacked(view.mask for view in views),
        "valid": (stacked(view.valid for view in views) > 0.99).astype(np.float32),
    }


def resized(image: Array, size: int) -> Array:
    if image.shape[0] == size:
        return image
    return np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA), np.float32)


def without_shell(at: Array, layout: PointLayout) -> Array:
    """Places (P, 3) of cvthead.source with the shell points not seen."""
    out = at.copy()
    out[layout.surface :, 2] = 0
    return out


def as_view(frame: Frame, points: Array) -> View:
    image = frame.image.astype(np.float32) / np.float32(255)
    return View(image, frame.mask, frame.valid.astype(np.float32), points)


def flip_order(values: NDArray[np.float32], layout: PointLayout) -> Array:
    """Each surface point takes the value of its mirrored counterpart; shell points their own."""
    out = values.copy()
    out[: layout.surface] = values[layout.mirror]
    return out


def flip_points(points: Array, layout: PointLayout) -> Array:
    """Projections of the head seen in a mirror."""
    return flip_order(points, layout) * np.array([-1, 1, 1], np.float32)


def mirrored(view: View, layout: PointLayout) -> View:
    return View(
        view.image[:, ::-1],
        view.mask[:, ::-1],
        view.valid[:, ::-1],
        flip_points(view.points, layout),
        view.carries_shell,
    )
