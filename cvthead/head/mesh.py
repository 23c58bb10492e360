"""Edges and normals of a triangle mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def edges(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """(F, 3) triangles -> (E, 2) vertex pairs, each edge once, lower number first, sorted."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    low, high = sides.min(axis=1).astype(np.int64), sides.max(axis=1)
    # One number per pair sorts a hundred times faster than rows.
    count = int(sides.max(initial=0)) + 1
    pairs = np.unique(low * count + high)
    return np.stack([pairs // count, pairs % count], axis=1).astype(np.int32)


def vertex_normals(positions: Array, faces: NDArray[np.integer]) -> Array:
    """Area-weighted unit normals (N, 3)."""
    corners = positions[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    count = len(positions)
    total = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(normals[:, axis], 3), minlength=count)
            for axis in range(3)
        ],
        axis=1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True) + 1e-12
    return np.asarray(total / length, dtype=np.float32)
