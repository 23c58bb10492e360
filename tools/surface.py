"""A triangle surface whose vertices are linear combinations of base-mesh vertices.

Cutting and subdividing only compose the sparse ``matrix``, so every per-vertex array of the
base mesh (template, bases, weights) carries over with one product.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Edge = tuple[int, int]


@dataclass(frozen=True)
class Surface:
    """Attributes:
    matrix: (N, base vertices) sparse rows that sum to 1.
    faces, uv_faces: (F, 3) indices into the N vertices and the T uvs.
    uv: (T, 2).
    """

    matrix: sparse.csr_array
    faces: Ints
    uv: Floats
    uv_faces: Ints

    def carry(self, values: NDArray[np.floating]) -> Floats:
        """Base-mesh values (base vertices, ...) -> values (N, ...) on this surface."""
        flat = self.matrix @ values.reshape(len(values), -1)
        return np.asarray(flat).reshape(-1, *values.shape[1:])

    def compact(self) -> Surface:
        """Without unused vertices and uvs; the order of the used ones is kept."""
        used, faces = np.unique(self.faces, return_inverse=True)
        used_uv, uv_faces = np.unique(self.uv_faces, return_inverse=True)
        return Surface(
            self.matrix[used],
            faces.reshape(-1, 3),
            self.uv[used_uv],
            uv_faces.reshape(-1, 3),
        )


def edge(a: int, b: int) -> Edge:
    return (a, b) if a < b else (b, a)


class _Blender:
    """Collects new vertices and uvs as blends of two old ones, one for each edge."""

    def __init__(self, surface: Surface) -> None:
        self._surface = surface
        self._pairs: list[tuple[int, int, float]] = []
        self._index: dict[Edge, int] = {}
        self._uvs: list[Floats] = []
        self._uv_index: dict[Edge, int] = {}

    def blend(self, a: int, b: int, ta: int, tb: int, t: float) -> tuple[int, int]:
        """Vertex and uv at (1 - t) of corner a and t of corner b."""
        key, uv_key = edge(a, b), edge(ta, tb)
        if key not in self._index:
            self._index[key] = self._surface.matrix.shape[0] + len(self._pairs)
            self._pairs.append((a, b, t))
        if uv_key not in self._uv_index:
            self._uv_index[uv_key] = len(self._surface.uv) + len(self._uvs)
            self._uvs.append((1 - t) * self._surface.uv[ta] + t * self._surface.uv[tb])
        return self._index[key], self._uv_index[uv_key]

    def finish(self, faces: list[list[int]], uv_faces: list[list[int]]) -> Surface:
        matrix = self._surface.matrix
        if self._pairs:
            matrix = sparse.vstack([matrix, blend_rows(matrix, self._pairs)]).tocsr()
        uv = np.concatenate([self._surface.uv, np.array(self._uvs).reshape(-1, 2)])
        return Surface(matrix, np.array(faces), uv, np.array(uv_faces)).compact()


def blend_rows(matrix: sparse.csr_array, pairs: list[tuple[int, int, float]]) -> sparse.csr_array:
    """Rows (1 - t) matrix[a] + t matrix[b] of every (a, b, t)."""
    a, b = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    t = np.array([p[2] for p in pairs])
    return sparse.csr_array(
        sparse.diags_array(1 - t) @ matrix[a] + sparse.diags_array(t) @ matrix[b]
    )


def clip(surface: Surface, base: Floats, normal: Floats, offset: float) -> Surface:
    """The part of the surface where ``normal . point >= offset``, cut straight.

    ``base``: base-mesh positions (base vertices, 3) that the plane refers to.

    Vertices close to the plane slide onto it first, which avoids sliver triangles.
    """
    points = surface.carry(base)
    surface, distance = _slide(surface, points, points @ normal - offset)
    points = surface.carry(base)
    blender = _Blender(surface)
    faces: list[list[int]] = []
    uv_faces: list[list[int]] = []
    for face, uv_face in zip(surface.faces.tolist(), surface.uv_faces.tolist(), strict=True):
        if not (distance[face] > 0).any():
            continue
        polygon: list[tuple[int, int]] = []
        places: list[Floats] = []
        for k in range(3):
            a, b = face[k], face[(k + 1) % 3]
            ta, tb = uv_face[k], uv_face[(k + 1) % 3]
            if distance[a] >= 0:
                polygon.append((a, ta))
                places.append(points[a])
            if distance[a] * distance[b] < 0:
                t = float(distance[a] / (distance[a] - distance[b]))
                polygon.append(blender.blend(a, b, ta, tb, t))
                places.append((1 - t) * points[a] + t * points[b])
        for corners in split_polygon(places):
            faces.append([polygon[k][0] for k in corners])
            uv_faces.append([polygon[k][1] for k in corners])
    return blender.finish(faces, uv_faces)


def split_polygon(polygon: Sequence[Floats] | Floats) -> tuple[tuple[int, int, int], ...]:
    """A triangle as it is; a quadrangle split along its shorter diagonal, so that mirrored
    quadrangles are split alike."""
    if len(polygon) == 3:
        return ((0, 1, 2),)
    first = np.linalg.norm(polygon[0] - polygon[2])
    second = np.linalg.norm(polygon[1] - polygon[3])
    return ((0, 1, 2), (0, 2, 3)) if first <= second else ((0, 1, 3), (1, 2, 3))


def _slide(surface: Surface, points: Floats, distance: Floats) -> tuple[Surface, Floats]:
    """Move vertices within 30 % of a crossing edge onto the plane, along that edge."""
    border = _border(surface.faces)
    on_border = {v for e in border for v in e}
    best: dict[int, tuple[float, int]] = {}
    for face in surface.faces.tolist():
        for k in range(3):
            for a, b in ((face[k], face[(k + 1) % 3]), (face[(k + 1) % 3], face[k])):
                if distance[a] * distance[b] >= 0:
                    continue
                # A vertex of the symmetry plane must stay in it.
                if abs(points[a, 0]) < 1e-6 < abs(points[b, 0]):
                    continue
                # A vertex of an earlier cut must stay on that cut.
                if a in on_border and edge(a, b) not in border:
                    continue
                t = float(distance[a] / (distance[a] - distance[b]))
                if t < 0.3 and t < best.get(a, (1.0, 0))[0]:
                    best[a] = (t, b)
    if not best:
        return surface, distance
    uv = surface.uv.copy()
    for face, uv_face in zip(surface.faces.tolist(), surface.uv_faces.tolist(), strict=True):
        for k, vertex in enumerate(face):
            if vertex in best and best[vertex][1] in face:
                t, other = best[vertex]
                end = surface.uv[uv_face[face.index(other)]]
                uv[uv_face[k]] = (1 - t) * surface.uv[uv_face[k]] + t * end
    moves = [(a, b, t) for a, (t, b) in best.items()]
    slid = np.array([a for a, _, _ in moves])
    rows = surface.matrix.tolil()
    rows[slid] = blend_rows(surface.matrix, moves).tolil()
    distance = distance.copy()
    distance[slid] = 0.0
    return replace(surface, matrix=sparse.csr_array(rows), uv=uv), distance


def _border(faces: Ints) -> set[Edge]:
    """Edges of one face only."""
    seen: Counter[Edge] = Counter(
        edge(face[k], face[(k + 1) % 3]) for face in faces.tolist() for k in range(3)
    )
    return {e for e, count in seen.items() if count == 1}


def subdivide(surface: Surface, marked: NDArray[np.bool_]) -> Surface:
    """Split every marked face into four; their neighbours into two (red-green refinement)."""
    split: set[Edge] = set()
    triangles = surface.faces.tolist()
    for face in surface.faces[marked].tolist():
        split |= {edge(face[k], face[(k + 1) % 3]) for k in range(3)}
    while True:  # a face with two split edges gets the third
        grown = set(split)
        for face in triangles:
            edges = [edge(face[k], face[(k + 1) % 3]) for k in range(3)]
            if sum(e in split for e in edges) == 2:
                grown.update(edges)
        if grown == split:
            break
        split = grown
    blender = _Blender(surface)
    faces: list[list[int]] = []
    uv_faces: list[list[int]] = []
    for face, uv_face in zip(triangles, surface.uv_faces.tolist(), strict=True):
        cut = [k for k in range(3) if edge(face[k], face[(k + 1) % 3]) in split]
        mids = {
            k: blender.blend(face[k], face[(k + 1) % 3], uv_face[k], uv_face[(k + 1) % 3], 0.5)
            for k in cut
        }
        corners = [(face[k], uv_face[k]) for k in range(3)]
        if len(cut) == 3:
            pieces = [[corners[k], mids[k], mids[(k + 2) % 3]] for k in range(3)] + [
                [mids[0], mids[1], mids[2]]
            ]
        elif len(cut) == 1:
            a, b, c = (corners[(cut[0] + k) % 3] for k in range(3))
            pieces = [[a, mids[cut[0]], c], [mids[cut[0]], b, c]]
        else:
            pieces = [corners]
        for piece in pieces:
            faces.append([corner[0] for corner in piece])
            uv_faces.append([corner[1] for corner in piece])
    return blender.finish(faces, uv_faces)
