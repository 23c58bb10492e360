"""Closest points on a triangle mesh, exact, by checking the triangles nearest by centroid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]


def closest_points(
    points: Floats, vertices: Floats, faces: NDArray[np.integer], candidates: int = 40
) -> tuple[NDArray[np.int64], Floats]:
    """Index (P,) of the nearest face and barycentric coordinates (P, 3) of the nearest place."""
    corners = vertices[faces]
    count = min(candidates, len(faces))
    _, near = cKDTree(corners.mean(1)).query(points, k=count)
    near = near.reshape(len(points), count)
    best = np.full(len(points), np.inf)
    face = np.zeros(len(points), np.int64)
    barycentric = np.zeros((len(points), 3))
    for column in near.T:
        weights = _closest_in_triangle(points, corners[column])
        place = np.einsum("pk,pkc->pc", weights, corners[column])
        distance = ((place - points) ** 2).sum(1)
        better = distance < best - 1e-16
        best[better], face[better], barycentric[better] = (
            distance[better],
            column[better],
            weights[better],
        )
    return face, barycentric


def _closest_in_triangle(points: Floats, corners: Floats) -> Floats:
    """Barycentric coordinates (P, 3) of the place in each triangle (P, 3, 3) nearest its point."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    u, v, p = b - a, c - a, points - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    pu, pv = (p * u).sum(1), (p * v).sum(1)
    area = np.maximum(uu * vv - uv * uv, 1e-30)
    s, t = (vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area
    inside = np.stack([1 - s - t, s, t], axis=1)
    best = np.where((inside >= 0).all(1), 0.0, np.inf)
    result = inside.clip(0)
    result /= result.sum(1, keepdims=True)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start, along = corners[:, i], corners[:, j] - corners[:, i]
        length = np.maximum((along * along).sum(1), 1e-30)
        share = (((points - start) * along).sum(1) / length).clip(0, 1)
        distance = ((start + share[:, None] * along - points) ** 2).sum(1)
        better = distance < best
        edge = np.zeros_like(result)
        rows = np.arange(len(points))
        edge[rows, i], edge[rows, j] = 1 - share, share
        result[better] = edge[better]
        best[better] = distance[better]
    return result
