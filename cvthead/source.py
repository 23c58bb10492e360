"""Everything that is read from a source portrait before the network sees it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera, Crop
from cvthead.clear import clear_points
from cvthead.coefficients import Coefficients
from cvthead.crop import head_crop
from cvthead.deformation import Deformation, DeformationModel, points, to_pixels
from cvthead.head.model import HeadModel, Region
from cvthead.hidden import hidden_colours
from cvthead.points import SEEN, SEEN_MIRRORED, PointLayout
from cvthead.silhouette import person_mask
from cvthead.tracking.tracker import TrackedFace, Tracker
from cvthead.visibility import eroded, on_person, visible_points

Array = NDArray[np.float32]

# 12 pixels to each side, as wide as loose hair. What is faintly segmented farther off is no person.
SOFT_EDGE = np.ones((25, 25), np.uint8)
# A probability is no coverage. Where the segmentation doubts whole regions beside the person, they
# would show as fog; what is this near to 0 or 1 counts as decided.
DECIDED = 0.25


@dataclass(frozen=True, eq=False)
class HeadCrop:
    """A tracked head cut out of its image.

    Attributes:
        image: (256, 256, 3) uint8 RGB, border replicated beyond the picture.
        mask: (256, 256) float32 person mask 0..1, 0 beyond the picture.
        valid: (256, 256) bool, False beyond the picture.
        crop: where it lies in the image.
        camera: weak perspective in the crop's normalised coordinates.
        coefficients: of the tracked head.
    """

    image: NDArray[np.uint8]
    mask: Array
    valid: NDArray[np.bool_]
    crop: Crop
    camera: Camera
    coefficients: Coefficients

    @cached_property
    def network_input(self) -> Array:
        """(4, 256, 256): RGB in [-1, 1], 0 outside the person, and the mask."""
        return network_input(self.image, self.mask)


@dataclass(frozen=True, eq=False)
class Source:
    """A head crop with hair and shoulders fitted: the input of the descriptor network.

    Attributes:
        head: the crop.
        deformation: hair and shoulders in rest space.
        points: (P, 3) normalised projections, numbered by the PointLayout.
        visible: (P,) bool, which of them the portrait sees.
        clear: (P,) bool, which of those have their own colour, see cvthead.clear.
        drawn: (P,) bool, which of them are part of the avatar; the others lie beyond the
            picture's edge, or beside the person.
    """

    head: HeadCrop
    deformation: Deformation
    points: Array
    visible: NDArray[np.bool_]
    clear: NDArray[np.bool_]
    drawn: NDArray[np.bool_]

    def places(self, layout: PointLayout) -> Array:
        """(P, 3) each point's x and y in the portrait, and how the portrait sees it."""
        return places(layout, self.points, self.visible)

    def hidden(self, layout: PointLayout) -> Array:
        """(P, 3) colours of the points that the portrait hides, see cvthead.hidden."""
        return hidden_colours(layout, self.network_input, self.points, self.clear)

    @property
    def network_input(self) -> Array:
        """That of the crop."""
        return self.head.network_input


def places(layout: PointLayout, points: Array, visible: NDArray[np.bool_]) -> Array:
    """(P, 3) normalised x and y of source projections (P, 3), then 1 where visible (P,), 0.5 where
    only the mirrored point is, else 0."""
    across = np.zeros_like(visible)
    across[: layout.surface] = visible[layout.mirror]
    seen = np.where(visible, SEEN, np.where(across, SEEN_MIRRORED, 0))
    return np.concatenate([points[:, :2], seen[:, None]], axis=1).astype(np.float32)


def network_input(image: NDArray[np.uint8], mask: Array) -> Array:
    """RGB (S, S, 3) uint8 and mask (S, S) -> (4, S, S) float32 for the encoder."""
    rgb = image.astype(np.float32).transpose(2, 0, 1) * np.float32(2 / 255) - 1
    return np.concatenate([rgb * mask, mask[None]])


def portrait_pixels(source: Array) -> NDArray[np.uint8]:
    """(4, S, S) of :func:`network_input` -> (S, S, 4) uint8, as an Avatar keeps it."""
    shown = (source.transpose(1, 2, 0) + np.array([1, 1, 1, 0], np.float32)) * np.array(
        [127.5, 127.5, 127.5, 255], np.float32
    )
    return np.rint(shown).astype(np.uint8)


def as_network_input(pixels: NDArray[np.uint8]) -> Array:
    """(S, S, 4) uint8 of an Avatar's portrait -> (4, S, S) as :func:`network_input` has it."""
    scale = np.array([2 / 255, 2 / 255, 2 / 255, 1 / 255], np.float32)
    out = pixels * scale - np.array([1, 1, 1, 0], np.float32)
    return np.ascontiguousarray(out.transpose(2, 0, 1))


def cut_head(
    tracker: Tracker, image: NDArray[np.uint8], face: TrackedFace, crop: Crop | None = None
) -> HeadCrop:
    """Crop, mask and camera of a tracked face; the crop is the head's own unless one is given."""
    crop = crop or head_crop(tracker.head, face.coefficients, face.camera)
    pixels, valid = crop.cut(image)
    probability = tracker.networks.person_mask(pixels)
    camera = face.camera.in_crop(crop)
    vertices = tracker.head.vertices(face.coefficients)[tracker.head.region == Region.FACE]
    kept = person_mask(probability, valid, to_pixels(camera.project(vertices)))
    near = cv2.dilate(kept.astype(np.uint8), SOFT_EDGE) > 0
    coverage = np.clip((probability - DECIDED) / (1 - 2 * DECIDED), 0, 1)
    mask = np.where(kept | (near & (probability < 0.5)), coverage, 0) * valid
    return HeadCrop(pixels, mask.astype(np.float32), valid, crop, camera, face.coefficients)


def driven_points(
    head: HeadModel,
    layout: PointLayout,
    coefficients: Coefficients,
    deformation: Deformation,
    camera: Camera,
) -> Array:
    """Posed, deformed and projected points (P, 3) in normalised coordinates."""
    return layout.arrange(camera.project(points(head, coefficients, deformation)))


def read_source(
    deformer: DeformationModel,
    layout: PointLayout,
    head: HeadCrop,
    *,
    deform: bool = True,
    all_seen: bool = False,
) -> Source:
    """Fit hair and shoulders to the crop and find what it shows.

    Args:
        deformer: of the tracker's head model.
        layout: point numbering of the same head model.
        head: the crop.
        deform: False leaves the head bald: the ablation without deformation.
        all_seen: True takes every point as seen: the ablation with pixel-aligned features alone.
    """
    model = deformer.head
    if deform:
        person = head.mask > 0.5
        deformation = deformer.fit(head.coefficients, head.camera, person, head.valid)
    else:
        deformation = Deformation.none(model)
    projected = driven_points(model, layout, head.coefficients, deformation, head.camera)
    if all_seen:
        visible = clear = np.ones(len(projected), np.bool_)
    else:
        mask = eroded(head.mask, 1)
        visible = visible_points(layout, projected, mask, head.camera.scale)
        clear = clear_points(layout, head.network_input, projected, visible)
    drawn = on_person(projected, head.mask)
    return Source(head, deformation, projected, visible, clear, drawn)
