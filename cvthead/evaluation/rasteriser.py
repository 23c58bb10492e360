"""Triangles with interpolated colours into an image, by z-buffer, on NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

# Grazing triangles interpolate nothing but noise.
MIN_AREA = 1e-6


def owners(
    projected: Array, faces: NDArray[np.integer], size: int
) -> tuple[NDArray[np.int64], Array, Array]:
    """The nearest triangle at each pixel centre.

    Args:
        projected: (N, 3) x, y in pixels (centre of the first pixel 0.5) and depth, smaller is
            nearer.
        faces: (F, 3) vertex numbers; either winding is drawn.
        size: image height and width.

    Returns:
        Face number (size, size), -1 where empty; its barycentric coordinates (size, size, 3);
        its depth (size, size), infinite where empty.
    """
    corners = projected[faces].astype(np.float64)
    low = np.clip(np.ceil(corners[..., :2].min(1) - 0.5), 0, size).astype(np.int64)
    high = np.clip(np.floor(corners[..., :2].max(1) - 0.5) + 1, 0, size).astype(np.int64)
    extent = np.maximum(high - low, 0)
    side_a, side_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = side_a[:, 0] * side_b[:, 1] - side_a[:, 1] * side_b[:, 0]
    # One candidate per triangle and pixel of its bounding box.
    count = np.where(np.abs(area) > MIN_AREA, extent.prod(1), 0)
    face = np.repeat(np.arange(len(faces)), count)
    place = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    column = low[face, 0] + place % extent[face, 0]
    row = low[face, 1] + place // extent[face, 0]
    x, y = column + 0.5 - corners[face, 0, 0], row + 0.5 - corners[face, 0, 1]
    second = (x * side_b[face, 1] - y * side_b[face, 0]) / area[face]
    third = (y * side_a[face, 0] - x * side_a[face, 1]) / area[face]
    inside = (second >= 0) & (third >= 0) & (second + third <= 1)
    face, second, third = face[inside], second[inside], third[inside]
    pixel = row[inside] * size + column[inside]
    weights = np.stack([1 - second - third, second, third], axis=1)
    depth = (corners[face, :, 2] * weights).sum(1)

    # Far to near, so that the nearest is written last.
    order = np.argsort(-depth, kind="stable")
    winner = np.full(size * size, -1, dtype=np.int64)
    winner[pixel[order]] = order
    hit = winner >= 0
    owner = np.where(hit, face[winner], -1) if len(face) else winner
    bary = np.zeros((size * size, 3), dtype=np.float32)
    bary[hit] = weights[winner[hit]]
    buffer = np.full(size * size, np.inf, dtype=np.float32)
    buffer[hit] = depth[winner[hit]]
    return owner.reshape(size, size), bary.reshape(size, size, 3), buffer.reshape(size, size)


def shade(
    owner: NDArray[np.int64], bary: Array, faces: NDArray[np.integer], values: Array
) -> Array:
    """Interpolate values (N, C) of the vertices: (size, size, C), 0 where empty."""
    image = np.zeros((*owner.shape, values.shape[1]), dtype=np.float32)
    hit = owner >= 0
    image[hit] = np.einsum("pk,pkc->pc", bary[hit], values[faces[owner[hit]]])
    return image
