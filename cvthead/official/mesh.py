"""The released mesh hierarchy: ``data/transform.pkl`` and the spirals built from it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from cvthead.head.hierarchy import SPIRAL_LENGTH, MeshHierarchy
from cvthead.head.spirals import spirals_of
from cvthead.official.halfedges import HalfedgeMesh
from cvthead.official.keys import refuse, table_problems
from cvthead.official.unpickle import load_pickle, named_tables

LEVELS = 2  # steps of the hierarchy that the network uses; the file has four
COUNTS = (5023, 1256, 314, 79, 20)
FACES = (9976, 2464, 597, 139, 34)
CORNERS = 3
SHAPES = {
    **{f"vertices[{k}]": (count, 3) for k, count in enumerate(COUNTS)},
    **{f"face[{k}]": (count, CORNERS) for k, count in enumerate(FACES)},
    **{f"down_transform[{k}]": (n, m) for k, (m, n) in enumerate(pairwise(COUNTS))},
    **{f"up_transform[{k}]": counts for k, counts in enumerate(pairwise(COUNTS))},
}
ENTRIES = ("vertices", "face", "down_transform", "up_transform")

Ints = NDArray[np.int32]
Array = NDArray[np.float32]


def read_hierarchy(path: Path) -> MeshHierarchy:
    """Selections, interpolation weights and spirals of the three levels.

    Raises:
        AssetError: unreadable, refused by the unpickler, or not these tables; names every one.
    """
    stored = named_tables(path, load_pickle(path))
    # Its entry "adj" follows from the faces and is not read.
    tables = {
        f"{name}[{k}]": table
        for name in ENTRIES
        for k, table in enumerate(_levels(stored.get(name)))
    }
    problems = table_problems(tables, SHAPES, {f"face[{k}]": n for k, n in enumerate(COUNTS)})
    for k in range(LEVELS):
        down, up = f"down_transform[{k}]", f"up_transform[{k}]"
        if down not in problems and not _selects(tables[down]):
            problems[down] = f"{down} does not select one vertex a row"
        if up not in problems and (_entries(tables[up]) != CORNERS).any():
            problems[up] = f"{up} does not weigh {CORNERS} vertices a row"
    refuse(str(path), problems.values())
    levels = range(LEVELS)
    return MeshHierarchy(
        tuple(_selection(tables[f"down_transform[{k}]"]) for k in levels),
        tuple(_weights(tables[f"up_transform[{k}]"]) for k in levels),
        tuple(_spirals(tables[f"vertices[{k}]"], tables[f"face[{k}]"]) for k in levels),
    )


def _levels(entry: object) -> Sequence[Any]:
    """The tables of an entry; none of what is no list."""
    return entry if isinstance(entry, list | tuple) else ()


def _entries(table: Any) -> NDArray[Any]:
    """Stored in each row."""
    return np.asarray(np.diff(csr_matrix(table).indptr))


def _selects(table: Any) -> bool:
    return bool((_entries(table) == 1).all() and (csr_matrix(table).data == 1).all())


def _spirals(points: NDArray[Any], faces: NDArray[Any]) -> Ints:
    mesh = HalfedgeMesh(len(points), (tuple(face) for face in faces.astype(np.int64).tolist()))
    rings = [mesh.ring(vertex) for vertex in range(len(points))]
    return spirals_of(rings, points.astype(np.float64), SPIRAL_LENGTH).astype(np.int32)


def _selection(table: Any) -> Ints:
    return np.asarray(csr_matrix(table).indices, dtype=np.int32)


def _weights(table: Any) -> tuple[Ints, Array]:
    rows = csr_matrix(table)
    shape = (rows.shape[0], CORNERS)
    # Used as stored: some are negative, and the rows do not sum to 1.
    return rows.indices.reshape(shape).astype(np.int32), rows.data.reshape(shape).astype(np.float32)
