"""The released mesh hierarchy: ``data/transform.pkl`` and the spirals built from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from cvthead.errors import AssetError
from cvthead.head.hierarchy import SPIRAL_LENGTH, MeshHierarchy
from cvthead.head.spirals import spirals_of
from cvthead.official.halfedges import HalfedgeMesh
from cvthead.official.unpickle import HINT, load_pickle

LEVELS = 2  # steps of the hierarchy that the network uses; the file has four
COUNTS = (5023, 1256, 314)
CORNERS = 3

Ints = NDArray[np.int32]
Array = NDArray[np.float32]


def read_hierarchy(path: Path) -> MeshHierarchy:
    """Selections, interpolation weights and spirals of the three levels.

    Raises:
        AssetError: unreadable, refused by the unpickler, or not these tables.
    """
    tables = load_pickle(path)
    try:
        faces = [_faces(tables["face"][k], COUNTS[k]) for k in range(LEVELS)]
        points = [_points(tables["vertices"][k], COUNTS[k]) for k in range(LEVELS)]
        down = [_selection(tables["down_transform"][k], COUNTS[k : k + 2]) for k in range(LEVELS)]
        up = [_weights(tables["up_transform"][k], COUNTS[k : k + 2]) for k in range(LEVELS)]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise AssetError(f"{path} is not the released transform.pkl: {error}", hint=HINT) from error
    tables_of_levels = tuple(_spirals(p, f) for p, f in zip(points, faces, strict=True))
    return MeshHierarchy(tuple(down), tuple(up), tables_of_levels)


def _spirals(points: NDArray[np.float64], faces: Ints) -> Ints:
    mesh = HalfedgeMesh(len(points), (tuple(face) for face in faces.tolist()))
    rings = [mesh.ring(vertex) for vertex in range(len(points))]
    return spirals_of(rings, points, SPIRAL_LENGTH).astype(np.int32)


def _faces(value: Any, count: int) -> Ints:
    faces = np.asarray(value).astype(np.int64)
    if faces.ndim != 2 or faces.shape[1] != CORNERS or faces.min() < 0 or faces.max() >= count:
        raise ValueError(f"faces of {count} vertices")
    return faces.astype(np.int32)


def _points(value: Any, count: int) -> NDArray[np.float64]:
    points = np.asarray(value, np.float64)
    if points.shape != (count, 3):
        raise ValueError(f"vertices have shape {points.shape}, not {(count, 3)}")
    return points


def _selection(matrix: csc_matrix, counts: tuple[int, ...]) -> Ints:
    fine, coarse = counts
    rows = matrix.tocsr()
    if rows.shape != (coarse, fine) or rows.nnz != coarse or (rows.data != 1).any():
        raise ValueError("down_transform does not select one vertex a row")
    return np.asarray(rows.indices, dtype=np.int32)


def _weights(matrix: csc_matrix, counts: tuple[int, ...]) -> tuple[Ints, Array]:
    fine, coarse = counts
    rows = matrix.tocsr()
    if rows.shape != (fine, coarse) or (np.diff(rows.indptr) != CORNERS).any():
        raise ValueError(f"up_transform does not weigh {CORNERS} vertices a row")
    shape = (fine, CORNERS)
    # Used as stored: some are negative, and the rows do not sum to 1.
    return rows.indices.reshape(shape).astype(np.int32), rows.data.reshape(shape).astype(np.float32)
