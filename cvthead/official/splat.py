"""The paper preset's splat (cvthead/model/splat.py) in NumPy, one frame at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cvthead.runtime.splat import EMPTY_DEPTH, front_points

Array = NDArray[np.float32]


def nearest_points(points: Array, size: int) -> NDArray[np.int64]:
    """The front point at each pixel, as the released code has it.

    Normalised 0 is the centre of pixel ``size / 2``. A point belongs to the nearest pixel, halves
    to the even one; points outside the frame are clamped onto its border.

    Args:
        points: (P, 3) normalised driven projections.
        size: image height and width.

    Returns:
        (size * size,) point number, -1 where empty. Of points at equal depth the one with the
        higher number wins.
    """
    half = np.float32(size / 2)
    place = np.rint((points[:, :2] * half + half).clip(0, size - 1)).astype(np.int64)
    depth = np.ascontiguousarray(points[:, 2])
    return front_points(place[:, 1] * size + place[:, 0], depth, size * size)


def splat(points: Array, descriptors: Array, size: int, channels: int) -> Array:
    """Depth and descriptors of the front points as an image.

    Args:
        points: (P, 3) normalised driven projections.
        descriptors: (P, C).
        size: image height and width.
        channels: of the image, at least 1 + C; the rest is 0.

    Returns:
        (size, size, channels): depth first (-2 where empty), then descriptors (0 where empty).
    """
    # A last row answers for the empty pixels, whose owner is -1.
    rows = np.zeros((len(points) + 1, channels), np.float32)
    rows[:-1, 0], rows[-1, 0] = points[:, 2], EMPTY_DEPTH
    rows[:-1, 1 : 1 + descriptors.shape[1]] = descriptors
    return rows[nearest_points(points, size)].reshape(size, size, channels)
