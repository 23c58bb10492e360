"""Spiral neighbourhoods of a triangle mesh (SpiralNet++, Gong et al. 2019)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def spirals_of(
    rings: list[list[int]], points: NDArray[np.float64], length: int
) -> NDArray[np.int64]:
    """(N, length): each vertex, its first ring, then further rings, cut to ``length``.

    A component with fewer vertices is filled up with the nearest others.

    Args:
        rings: neighbours of every vertex, clockwise.
        points: (N, 3) vertex positions.
        length: vertices of a spiral.
    """
    table = np.empty((len(points), length), np.int64)
    for vertex, first in enumerate(rings):
        spiral, last = [vertex, *first], first
        while len(spiral) < length and last:
            last = _next_ring(rings, last, spiral)
            spiral += last
        if len(spiral) < length:
            order = np.argsort(((points - points[vertex]) ** 2).sum(1), kind="stable")
            spiral += [int(v) for v in order if v not in set(spiral)]
        table[vertex] = spiral[:length]
    return table


def _next_ring(rings: list[list[int]], last: list[int], spiral: list[int]) -> list[int]:
    inside, seen = set(last), set(spiral)
    found: list[int] = []
    for vertex in last:
        ring = rings[vertex]
        # The walk begins behind the first neighbour that lies in the ring before.
        start = next((i + 1 for i, v in enumerate(ring) if v in inside), 0)
        for other in ring[start:] + ring[:start]:
            if other not in seen:
                seen.add(other)
                found.append(other)
    return found
