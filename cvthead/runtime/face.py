"""The face's triangles at full resolution: what they carry, and what they cover.

A splat of single points is too coarse for lids, irises and lips. It also has gaps, through which
teeth, eyeballs and neck would shine where cheeks, lids and jaw lie in front of them.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.points import FAR_AWAY, SEEN, SEEN_MIRRORED, PointLayout
from cvthead.runtime.splat import pixel_along
from cvthead.runtime.triangles import FAR, rasterise

Array = NDArray[np.float32]

LARGEST_FLOW = 2.0  # normalised: twice the picture's half width
COVER = 0.012  # normalised depth, about 2 mm: a point further behind a triangle is covered by it


class CarriedFace(NamedTuple):
    """The front triangles.

    Attributes:
        flow: (size, size, 2) normalised, from the driven frame back to the portrait.
        known: (size, size), where a triangle tells the flow.
        depth: (size, size) of the triangles, FAR where there is none.
    """

    flow: Array
    known: NDArray[np.bool_]
    depth: Array


def carried_face(layout: PointLayout, points: Array, places: Array, size: int) -> CarriedFace:
    """Draw the flow of the face's triangles. What of the face the portrait hides is taken from
    the other side, if that is seen.

    Args:
        layout: numbering of the points.
        points: (P, 3) normalised driven projections.
        places: (P, 3) each point's x and y in the portrait and how it is seen.
        size: of the frame.
    """
    own = layout.detail_vertices
    corners, faces = points[own], layout.detail_faces
    away = _votes(corners[:, 2] >= FAR, faces) > 0
    if away.any():
        faces = faces[~away]
    flow = np.zeros((size, size, 2), np.float32)
    if not len(faces):
        nothing = np.full((size, size), FAR, np.float32)
        return CarriedFace(flow, np.zeros((size, size), np.bool_), nothing)
    sources = places[own]
    seen = sources[:, 2] == SEEN
    across = sources[:, 2] == SEEN_MIRRORED
    mirrored = (_votes(across, faces) > 1) & (_votes(seen, faces) <= 1)
    if mirrored.any():
        # Every vertex twice: carried from its own place, and from the one across the face.
        faces = np.where(mirrored[:, None], faces + len(own), faces)
        corners = np.concatenate([corners, corners])
        sources = np.concatenate([sources, places[layout.mirror[own]]])
        seen = np.concatenate([seen, across])
    carry = np.clip(sources[:, :2] - corners[:, :2], -LARGEST_FLOW, LARGEST_FLOW)
    values = np.empty_like(corners)
    values[:, :2] = carry * np.float32(0.5 / LARGEST_FLOW) + np.float32(0.5)
    values[:, 2] = seen

    image, depth = rasterise(corners, faces, values, size)
    known = np.asarray(cv2.extractChannel(image, 2) > np.float32(0.5))
    image -= np.float32(0.5)
    image *= np.float32(2 * LARGEST_FLOW)
    cv2.mixChannels([image], [flow], [0, 0, 1, 1])
    return CarriedFace(flow, known, depth)


def without_covered(layout: PointLayout, points: Array, depth: Array) -> Array:
    """Points (P, 3) with those far away that the face's triangles cover, the face's own excepted,
    and the throat.

    Args:
        layout: numbering of the points.
        points: normalised driven projections.
        depth: (S, S) of :func:`carried_face`.
    """
    size = len(depth)
    x, y, z = np.ascontiguousarray(points.T)
    column, row = (pixel_along(each, size).clip(0, size - 1) for each in (x, y))
    covered = z > depth.ravel()[row * size + column] + np.float32(COVER)
    covered[layout.face] = False
    covered[layout.throat] = True
    out = points.copy()
    out[covered] = FAR_AWAY
    return out


def splatted(layout: PointLayout, points: Array, size: int) -> Array:
    """Driven points (P, 3) as cvthead.runtime.place splats them into a frame of this size."""
    depth = carried_face(layout, points, np.zeros_like(points), size).depth
    return without_covered(layout, points, depth)


def _votes(chosen: NDArray[np.bool_], faces: NDArray[np.int32]) -> NDArray[np.uint8]:
    """How many corners of each face (F, 3) are among the chosen vertices, 0 to 3."""
    first, second, third = faces.T
    counted = chosen.view(np.uint8)
    return np.asarray(counted[first] + counted[second] + counted[third])
