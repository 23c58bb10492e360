"""Spiral neighbourhoods of the open head's mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cvthead.head.spirals import spirals_of

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
    """(N, length) spirals over :func:`rings`, see :func:`spirals_of`."""
    return spirals_of(rings(points, faces), points, length)
