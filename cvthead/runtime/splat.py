"""The z-buffered splat of cvthead/model/splat.py in NumPy, one frame at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

EMPTY = -1
EMPTY_DEPTH = -2.0
BLOCK = 4  # pixels; wide enough that the points of the front surface leave no block empty
FRONT = 0.15  # thickness of the front surface in normalised depth, about 25 mm
NOTHING = np.iinfo(np.int64).max
NUMBER = 0xFFFFFFFF


def splat(points: Array, size: int) -> NDArray[np.int64]:
    """The front point at each pixel (paper section 3.4).

    Args:
        points: (P, 3) normalised driven projections.
        size: image height and width, a multiple of BLOCK.

    Returns:
        (size, size) point number, -1 where empty. Of points at equal depth the one with the
        higher number wins.
    """
    x, y, depth = np.ascontiguousarray(points.T)
    column, row = pixel_along(x, size), pixel_along(y, size)
    inside = np.nonzero((column >= 0) & (column < size) & (row >= 0) & (row < size))[0]
    column, row, depth = column[inside], row[inside], depth[inside]
    block = row // BLOCK * (size // BLOCK) + column // BLOCK
    nearest = np.full((size // BLOCK) ** 2, np.inf, np.float32)
    np.minimum.at(nearest, block, depth)
    front = np.nonzero(depth <= nearest[block] + np.float32(FRONT))[0]
    owner = front_points(row[front] * size + column[front], depth[front], size * size)
    shown = owner >= 0
    owner[shown] = inside[front[owner[shown]]]
    return owner.reshape(size, size)


def front_points(pixel: NDArray[np.int64], depth: Array, count: int) -> NDArray[np.int64]:
    """The nearest of the points at each pixel.

    Args:
        pixel: (P,) number of each point's pixel.
        depth: (P,) the nearest has the smallest.
        count: of the pixels.

    Returns:
        (count,) point number, EMPTY where there is none. Of points at equal depth the one with the
        higher number wins.
    """
    # Depth and number in one integer, whose minimum is the nearest point of the highest number: a
    # fraction of the time of sorting them.
    key = (_ordered(depth) << 32) - np.arange(len(depth))
    first = np.full(count, NOTHING, np.int64)
    np.minimum.at(first, pixel, key)
    return np.where(first == NOTHING, EMPTY, -first & NUMBER)


def pixel_along(coordinate: Array, size: int) -> NDArray[np.int64]:
    place = (coordinate * np.float32(0.5) + np.float32(0.5)) * np.float32(size)
    return np.asarray(np.floor(place), np.int64)


def _ordered(values: Array) -> NDArray[np.int64]:
    """Integers in the order of the float32 values."""
    bits = (values + np.float32(0)).view(np.int32)  # -0 becomes 0
    return np.where(bits < 0, bits ^ np.int32(0x7FFFFFFF), bits).astype(np.int64)
