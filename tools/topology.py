"""Which polygons of MakeHuman's body make up the head, and how they are triangulated."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tools.makehuman import BaseMesh, Corners
from tools.surface import Floats, Ints, Surface, split_polygon


class Part(IntEnum):
    BODY = 0
    LEFT_EYE = 1
    RIGHT_EYE = 2
    UPPER_TEETH = 3
    LOWER_TEETH = 4
    TONGUE = 5


_GROUPS = {
    "helper-l-eye": Part.LEFT_EYE,
    "helper-r-eye": Part.RIGHT_EYE,
    "helper-upper-teeth": Part.UPPER_TEETH,
    "helper-lower-teeth": Part.LOWER_TEETH,
    "helper-tongue": Part.TONGUE,
}
# Colours of eye_cavity.R, eye_cavity.L and mouth_cavity in the wheel's segmentation picture.
_CAVITIES = ((253, 249, 16), (249, 108, 136), (112, 172, 255))
# Generous limits in decimetres; build_head cuts the border inside them with planes.
_LOWEST, _WIDEST = 4.4, 2.7


@dataclass(frozen=True)
class BaseHead:
    """The head inside MakeHuman's base mesh.

    Attributes:
        ids: (B,) MakeHuman indices of the base vertices.
        part: (B,) Part of every base vertex.
        mirror: (B,) index of the vertex across the plane x = 0.
        surface: triangles over the B vertices, without eye and mouth cavities.
    """

    ids: Ints
    part: Ints
    mirror: Ints
    surface: Surface


def base_head(mesh: BaseMesh, segmentation: NDArray[np.uint8]) -> BaseHead:
    body = _largest_component(
        [
            polygon
            for polygon in mesh.groups["body"]
            if (mesh.vertices[polygon[0], 1] > _LOWEST).all()
            and (np.abs(mesh.vertices[polygon[0], 0]) < _WIDEST).all()
        ]
    )
    polygons = [(polygon, Part.BODY) for polygon in body]
    for group, part in _GROUPS.items():
        polygons += [(polygon, part) for polygon in mesh.groups[group]]

    ids = np.unique([v for (vertices, _), _ in polygons for v in vertices])
    local = {int(v): i for i, v in enumerate(ids)}
    labels = np.zeros(len(ids), np.int64)
    for (vertices, _), part in polygons:
        labels[[local[v] for v in vertices]] = part
    points = mesh.vertices[ids]
    mirror = mirror_map(points, labels)

    quads = [[local[v] for v in vertices] for (vertices, _), _ in polygons]
    uv_quads = [uvs for (_, uvs), _ in polygons]
    cavity = np.array(
        [
            part == Part.BODY and _in_cavity(mesh.uvs[uvs].mean(0), segmentation)
            for (_, uvs), part in polygons
        ]
    )
    index = {frozenset(quad): i for i, quad in enumerate(quads)}
    twin = [index[frozenset(mirror[quad].tolist())] for quad in quads]
    keep = ~(cavity | cavity[twin])
    faces: list[list[int]] = []
    uv_faces: list[list[int]] = []
    for i in np.nonzero(keep)[0]:
        # The half with x > 0 decides on the diagonal, so that the triangles are symmetric.
        leader = quads[i] if points[quads[i], 0].mean() >= 0 else mirror[quads[i]].tolist()
        for corners in split_polygon(points[leader]):
            faces.append([quads[i][k] for k in corners])
            uv_faces.append([uv_quads[i][k] for k in corners])
    surface = Surface(
        sparse.csr_array(sparse.eye_array(len(ids))),
        np.array(faces),
        mesh.uvs,
        np.array(uv_faces),
    )
    return BaseHead(ids, labels, mirror, surface.compact())


def mirror_map(points: Floats, part: Ints) -> Ints:
    """(N,) index of the vertex at the mirrored place; the eyes change sides.

    Raises:
        ValueError: the points are not symmetric to 1e-6 or the map is no bijection.
    """
    other = {Part.LEFT_EYE: Part.RIGHT_EYE, Part.RIGHT_EYE: Part.LEFT_EYE}
    mirror = np.empty(len(points), np.int64)
    for value in np.unique(part):
        here = np.nonzero(part == value)[0]
        there = np.nonzero(part == other.get(Part(value), Part(value)))[0]
        distance, nearest = cKDTree(points[there]).query(points[here] * [-1.0, 1.0, 1.0])
        if distance.max() > 1e-6:
            raise ValueError(f"{Part(value).name} is asymmetric by {distance.max():g}")
        mirror[here] = there[nearest]
    if len(np.unique(mirror)) != len(mirror):
        raise ValueError("the mirror map is not a bijection")
    return mirror


def _largest_component(polygons: list[Corners]) -> list[Corners]:
    start = np.array([vertices[0] for vertices, _ in polygons for _ in vertices])
    end = np.array([v for vertices, _ in polygons for v in vertices])
    size = int(max(start.max(), end.max())) + 1
    graph = sparse.coo_array((np.ones(len(start)), (start, end)), shape=(size, size))
    _, label = connected_components(graph, directed=False)
    of_polygon = label[[vertices[0] for vertices, _ in polygons]]
    biggest = np.bincount(of_polygon).argmax()
    return [polygons[i] for i in np.nonzero(of_polygon == biggest)[0]]


def _in_cavity(uv: Floats, segmentation: NDArray[np.uint8]) -> bool:
    height, width = segmentation.shape[:2]
    row = int(np.clip(round((1 - uv[1]) * height), 0, height - 1))
    column = int(np.clip(round(uv[0] * width), 0, width - 1))
    return tuple(segmentation[row, column].tolist()) in _CAVITIES
