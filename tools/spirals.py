"""Spiral neighbourhoods of a triangle mesh (SpiralNet++, Gong et al. 2019)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def rings(points: Floats, faces: Ints) -> list[list[int]]:
    """Neighbours of every vertex, clockwise seen from outside.

    A closed ring starts at its lowest neighbour, an open one at its end, so that spirals of
    neighbouring vertices start alike.
    """
    follow: list[dict[int, int]] = [{} for _ in points]
    for a, b, c in faces.tolist():  # counter-clockwise: walk backwards
        for centre, start, end in ((a, b, c), (b, c, a), (c, a, b)):
            follow[centre][end] = start
    result = []
    for step in follow:
        ring: list[int] = []
        open_ends = sorted(set(step) - set(step.values()))
        starts = open_ends or sorted(step, key=lambda v: points[v, 1])[:1]
        for start in starts:
            here: int | None = start
            while here is not None and here not in ring:
                ring.append(here)
                here = step.get(here)
        result.append(ring)
    return result


def spirals(points: Floats, faces: Ints, length: int) -> Ints:
    """(N, length): each vertex, its first ring, then further rings, cut to ``length``.

    A component with fewer vertices is filled up with the nearest others.
    """
    around = rings(points, faces)
    table = np.empty((len(points), length), np.int64)
    for vertex, first in enumerate(around):
        spiral, last = [vertex], first
        spiral += last
        while len(spiral) < length and last:
            last = _next_ring(around, last, spiral)
            spiral += last
        if len(spiral) < length:
            order = np.argsort(((points - points[vertex]) ** 2).sum(1), kind="stable")
            spiral += [int(v) for v in order if v not in set(spiral)]
        table[vertex] = spiral[:length]
    return table


def _next_ring(around: list[list[int]], last: list[int], spiral: list[int]) -> list[int]:
    inside = set(last)
    seen = set(spiral)
    found: list[int] = []
    for vertex in last:
        ring = around[vertex]
        start = next((i + 1 for i, v in enumerate(ring) if v in inside), 0)
        for other in ring[start:] + ring[:start]:
            if other not in seen:
                seen.add(other)
                found.append(other)
    return found
