"""What the network has to beat: a re-posed mesh with the source's colours, no learning.

The other baseline, copying the source, needs no code.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cvthead.camera import CROP_PIXELS, Camera
from cvthead.clear import sampled
from cvthead.coefficients import Coefficients
from cvthead.deformation import Deformation, points
from cvthead.evaluation.rasteriser import owners, shade
from cvthead.head.model import HeadModel

Array = NDArray[np.float32]

DEPTH_TOLERANCE = 0.005  # metres
DISC_RADIUS = 0.006  # metres; shell points lie about 0.006 apart
DISC_CORNERS = 8
SUPERSAMPLING = 2


@dataclass(frozen=True, eq=False)
class ColouredMesh:
    """Vertex colours of one person.

    Attributes:
        head: the head model.
        coefficients: of the source.
        deformation: hair and shoulders of the source.
        colours: (N + K, 3) of vertices and shell points, 0..1.
    """

    head: HeadModel
    coefficients: Coefficients
    deformation: Deformation
    colours: Array

    @classmethod
    def from_picture(
        cls,
        head: HeadModel,
        coefficients: Coefficients,
        camera: Camera,
        deformation: Deformation,
        crop: NDArray[np.uint8],
        mask: NDArray[np.bool_],
    ) -> ColouredMesh:
        """Colour the deformed head from its source picture.

        Visible vertices take the colour at their projection, hidden ones that of their mirrored
        vertex, and where this is hidden too, of the nearest visible vertex.

        Args:
            camera: in normalised coordinates of the crop.
            crop: (S, S, 3) source picture.
            mask: (S, S) pixels whose colour may be read: person, within the picture.
        """
        posed = points(head, coefficients, deformation)
        projected = in_pixels(camera.project(posed), crop.shape[0])
        tolerance = DEPTH_TOLERANCE * camera.scale * crop.shape[0] / 2
        seen = visible(projected, head.faces, mask, tolerance)
        return cls(
            head,
            coefficients,
            deformation,
            fill(sampled(crop, projected) / np.float32(255), seen, head.mirror, posed),
        )

    def render(
        self, coefficients: Coefficients, camera: Camera, size: int = CROP_PIXELS
    ) -> tuple[Array, Array]:
        """The person with another expression and pose.

        Args:
            camera: in normalised coordinates of the wanted crop.

        Returns:
            RGB (size, size, 3) in 0..1 on white and alpha (size, size).
        """
        fine = size * SUPERSAMPLING
        posed = points(self.head, coefficients, self.deformation)
        projected = in_pixels(camera.project(posed), fine)
        radius = DISC_RADIUS * camera.scale * fine / 2
        count = len(self.head.template)
        rim, discs = disc_fans(projected[count:], count, radius)
        faces = np.concatenate([self.head.faces, discs])
        colours = np.concatenate(
            [self.colours, np.repeat(self.colours[count:], DISC_CORNERS, axis=0)]
        )
        owner, bary, _ = owners(np.concatenate([projected, rim]), faces, fine)
        alpha = (owner >= 0).astype(np.float32)
        image = shade(owner, bary, faces, colours) + (1 - alpha[..., None])
        shrunk = cv2.resize(
            np.dstack([image, alpha]), (size, size), interpolation=cv2.INTER_AREA
        ).astype(np.float32, copy=False)
        return shrunk[..., :3], shrunk[..., 3]


def in_pixels(projected: Array, size: int) -> Array:
    """Normalised x, y and depth (N, 3) -> pixels, depth in pixels too."""
    half = np.float32(size / 2)
    return projected * half + np.array([half, half, 0], dtype=np.float32)


def visible(
    projected: Array, faces: NDArray[np.integer], mask: NDArray[np.bool_], tolerance: float
) -> NDArray[np.bool_]:
    """Points (N, 3) in pixels that lie in the mask (S, S) and not behind the mesh: (N,)."""
    size = mask.shape[0]
    depth = owners(projected, faces, size)[2]
    # The outermost pixels of the person mix with the background.
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    pixel = np.floor(projected[:, :2]).astype(np.int64)
    inside = ((pixel >= 0) & (pixel < size)).all(1)
    column, row = np.clip(pixel, 0, size - 1).T
    front = projected[:, 2] <= depth[row, column] + tolerance
    return np.asarray(inside & inner[row, column] & front)


def fill(
    colours: Array, seen: NDArray[np.bool_], mirror: NDArray[np.integer], positions: Array
) -> Array:
    """Give hidden points the colour of their mirror vertex, else of the nearest seen point.

    Args:
        colours: (N + K, 3); seen: (N + K,); mirror: (N,) number of the mirrored vertex;
            positions: (N + K, 3). Shell points (the last K) have no mirror.

    Returns:
        (N + K, 3); grey if nothing is seen.
    """
    if not seen.any():
        return np.full_like(colours, 0.5)
    filled, known = colours.copy(), seen.copy()
    twin = np.arange(len(colours))
    twin[: len(mirror)] = mirror
    borrow = ~seen & seen[twin]
    filled[borrow] = colours[twin[borrow]]
    known |= borrow
    nearest = cKDTree(positions[known]).query(positions[~known])[1]
    filled[~known] = filled[known][nearest]
    return filled


def disc_fans(centres: Array, first: int, radius: float) -> tuple[Array, NDArray[np.int64]]:
    """Discs facing the camera as triangle fans.

    Args:
        centres: (K, 3) pixels; vertex ``first`` is the first of them.
        radius: pixels.

    Returns:
        Rim vertices (K * DISC_CORNERS, 3), numbered on from the last centre, and faces.
    """
    angle = np.arange(DISC_CORNERS) * (2 * np.pi / DISC_CORNERS)
    step = np.stack([np.cos(angle), np.sin(angle), np.zeros(DISC_CORNERS)], 1) * radius
    rim = (centres[:, None] + step).reshape(-1, 3).astype(np.float32)
    centre = np.repeat(first + np.arange(len(centres)), DISC_CORNERS)
    start = first + len(centres) + DISC_CORNERS * np.arange(len(centres))[:, None]
    here = (start + np.arange(DISC_CORNERS)).reshape(-1)
    following = (start + (np.arange(DISC_CORNERS) + 1) % DISC_CORNERS).reshape(-1)
    return rim, np.stack([centre, here, following], axis=1)
