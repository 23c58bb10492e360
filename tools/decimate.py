"""Quadric edge collapse (Garland and Heckbert 1997) that keeps a subset of the vertices.

Every collapse moves one vertex of an edge onto the other, so a coarse level is a selection of
fine vertices, as the spiral hierarchy needs.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Penalty on edges that are long for their part of the mesh; keeps the density's proportions.
_EVENNESS = 0.02
_BORDER = 10.0


@dataclass(frozen=True)
class Decimated:
    """Attributes: kept (n,) ascending vertex indices; faces (f, 3) over 0..n-1."""

    kept: Ints
    faces: Ints


def components(count: int, faces: Ints) -> Ints:
    """(count,) label of each vertex's connected component."""
    return linked(count, np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]))


def linked(count: int, pairs: NDArray[np.integer]) -> Ints:
    """(count,) label of each vertex's component, of edges (E, 2)."""
    graph = sparse.coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1]).astype(np.int64)


def decimate(points: Floats, faces: Ints, target: int, least: int) -> Decimated:
    """Collapse edges, cheapest first, down to about ``target`` vertices.

    Every connected component shrinks by the same factor, but not below ``least`` vertices.
    """
    label = components(len(points), faces)
    sizes = np.bincount(label)
    quota = np.maximum(np.round(sizes * target / len(points)).astype(int), least)
    return _Collapser(points, faces, label, quota).run()


class _Collapser:
    """Working state of one decimation."""

    def __init__(self, points: Floats, faces: Ints, label: Ints, quota: Ints) -> None:
        self.points = points
        self.faces = faces.copy()
        self.label = label
        self.quota = quota
        self.left = np.bincount(label)
        self.alive = np.ones(len(points), bool)
        self.face_alive = np.ones(len(faces), bool)
        self.around: list[set[int]] = [set() for _ in points]
        for index, face in enumerate(faces.tolist()):
            for vertex in face:
                self.around[vertex].add(index)
        self.stamp = np.zeros(len(points), np.int64)
        self.quadrics = self._quadrics()
        self.spacing = self._spacing()
        self.heap: list[tuple[float, int, int, int]] = []

    def run(self) -> Decimated:
        for vertex in range(len(self.points)):
            self._push(vertex)
        while self.heap:
            _, gone, onto, stamp = heapq.heappop(self.heap)
            fresh = self.alive[gone] and self.alive[onto]
            if not fresh or stamp != self.stamp[gone] + self.stamp[onto]:
                continue
            component = self.label[gone]
            if self.left[component] <= self.quota[component] or not self._allowed(gone, onto):
                continue
            self._collapse(gone, onto)
        kept = np.nonzero(self.alive)[0]
        index = np.full(len(self.points), -1)
        index[kept] = np.arange(len(kept))
        return Decimated(kept, index[self.faces[self.face_alive]])

    def neighbours(self, vertex: int) -> set[int]:
        found = {int(v) for f in self.around[vertex] for v in self.faces[f]}
        return found - {vertex}

    def _spacing(self) -> Floats:
        """(N,) squared edge length around each vertex, over the mesh's mean."""
        corners = self.points[self.faces]
        square = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(2).mean(1)
        total, count = np.zeros(len(self.points)), np.zeros(len(self.points))
        for column in self.faces.T:
            np.add.at(total, column, square)
            np.add.at(count, column, 1)
        return np.asarray(total / count / square.mean())

    def _quadrics(self) -> Floats:
        """(N, 4, 4) squared distances to the planes of the faces, and to upright border planes."""
        quadrics = np.zeros((len(self.points), 4, 4))
        corners = self.points[self.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double = np.linalg.norm(cross, axis=1)
        normal = cross / np.maximum(double, 1e-15)[:, None]
        self._add_planes(quadrics, self.faces, normal, corners[:, 0], double / 2)
        edges = np.concatenate(
            [self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]
        )
        owner = np.tile(np.arange(len(self.faces)), 3)
        _, first, count = np.unique(
            np.sort(edges, 1), axis=0, return_index=True, return_counts=True
        )
        border, face = edges[first[count == 1]], owner[first[count == 1]]
        along = self.points[border[:, 1]] - self.points[border[:, 0]]
        side = np.cross(along, normal[face])
        length = np.maximum(np.linalg.norm(side, axis=1), 1e-15)
        weight = _BORDER * length**2
        start = self.points[border[:, 0]]
        self._add_planes(quadrics, border, side / length[:, None], start, weight)
        return quadrics

    @staticmethod
    def _add_planes(
        quadrics: Floats, owners: Ints, normal: Floats, point: Floats, weight: Floats
    ) -> None:
        plane = np.concatenate([normal, -(normal * point).sum(1, keepdims=True)], axis=1)
        outer = weight[:, None, None] * plane[:, :, None] * plane[:, None, :]
        for column in owners.T:
            np.add.at(quadrics, column, outer)

    def _push(self, vertex: int) -> None:
        """Queue the collapses of ``vertex`` onto its neighbours, and of them onto it."""
        for other in self.neighbours(vertex):
            for gone, onto in ((vertex, other), (other, vertex)):
                place = np.append(self.points[onto], 1.0)
                error = place @ (self.quadrics[gone] + self.quadrics[onto]) @ place
                length = ((self.points[gone] - self.points[onto]) ** 2).sum()
                cost = float(error + _EVENNESS * (length / self.spacing[gone]) ** 2)
                stamp = int(self.stamp[gone] + self.stamp[onto])
                heapq.heappush(self.heap, (cost, gone, onto, stamp))

    def _allowed(self, gone: int, onto: int) -> bool:
        """Whether the surface stays a manifold and no face turns over."""
        shared = self.around[gone] & self.around[onto]
        opposite = {int(v) for f in shared for v in self.faces[f]} - {gone, onto}
        if self.neighbours(gone) & self.neighbours(onto) != opposite:
            return False
        if self._on_border(gone) and (not self._on_border(onto) or len(shared) != 1):
            return False
        for face in self.around[gone] - shared:
            before = self.points[self.faces[face]]
            after = before.copy()
            after[self.faces[face] == gone] = self.points[onto]
            old = np.cross(before[1] - before[0], before[2] - before[0])
            new = np.cross(after[1] - after[0], after[2] - after[0])
            size = np.linalg.norm(old) * np.linalg.norm(new)
            if old @ new < 0.2 * size or size < 1e-20:
                return False
        return True

    def _on_border(self, vertex: int) -> bool:
        return len(self.around[vertex]) != len(self.neighbours(vertex))

    def _collapse(self, gone: int, onto: int) -> None:
        for face in list(self.around[gone]):
            if face in self.around[onto]:
                self.face_alive[face] = False
                for vertex in self.faces[face].tolist():
                    self.around[vertex].discard(face)
            else:
                self.faces[face][self.faces[face] == gone] = onto
                self.around[onto].add(face)
        self.alive[gone] = False
        self.left[self.label[gone]] -= 1
        self.quadrics[onto] += self.quadrics[gone]
        self.stamp[onto] += 1
        self._push(onto)
