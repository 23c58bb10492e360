"""What a frame shows where: the driven points splatted, and the portrait carried along.

A descriptor per point cannot hold every hair and pore. But each point knows where the portrait
shows it, so the splat also gives a flow from the driven frame back to the portrait; read through
it, the portrait is a sharp first guess of everything the source saw. The face, whose lids, irises
and lips move by less than a pixel of the splat, gets its flow from its triangles at full
resolution. What of it the portrait hides is taken from the other side, if that is seen.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.points import PointLayout
from cvthead.runtime.splat import EMPTY_DEPTH, splat
from cvthead.runtime.triangles import FAR, rasterise
from cvthead.runtime.warp import dense_flow, warp

Array = NDArray[np.float32]

PLACE_SIZE = 3  # a descriptor row's last values: x and y in the portrait, how it is seen
SEEN, SEEN_MIRRORED = 1.0, 0.5  # by the portrait; only the point across the face is; else 0
CLOSING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))  # closes gaps between points
SOFT_EDGE = np.ones((3, 3), np.uint8)
BEHIND = 0.06  # normalised depth, about 10 mm: further back a triangle lies behind the splat
LARGEST_FLOW = 2.0  # normalised: twice the picture's half width


class Placed(NamedTuple):
    """What the frame network reads, and how far its result may reach.

    Attributes:
        splat: (s, s, 1 + C + 1), depth, descriptor and how the portrait sees the point.
        warped: (size, size, 4) uint8, the portrait carried to the driven pose.
        reach: (size, size) uint8, highest alpha; see :func:`reach_of`.
    """

    splat: Array
    warped: NDArray[np.uint8]
    reach: NDArray[np.uint8]


def place(
    layout: PointLayout,
    points: Array,
    rows: Array,
    portrait: NDArray[np.uint8],
    splat_size: int,
    size: int,
) -> Placed:
    """Splat the rows and carry the portrait's pixels to the driven points.

    Args:
        layout: numbering of the points.
        points: (P, 3) normalised driven projections.
        rows: (P, C + 3) descriptor rows; C may be 0.
        portrait: (256, 256, 4) uint8, see Avatar.
        splat_size: height and width of the splat.
        size: of the frame.
    """
    flowing = rows.copy()
    flowing[:, -PLACE_SIZE:-1] -= points[:, :2]
    image = splat(points, flowing, splat_size)
    seen = (image[..., -1] == SEEN).astype(np.float32)
    flow = dense_flow(image[..., -PLACE_SIZE:-1], seen, size)
    _refine(flow, layout, points, rows, image[..., 0])
    warped = warp(portrait, flow)
    kept = np.concatenate([image[..., :-PLACE_SIZE], image[..., -1:]], axis=-1)
    return Placed(kept, warped, reach_of(image[..., 0], warped))


def _refine(flow: Array, layout: PointLayout, points: Array, rows: Array, depth: Array) -> None:
    """Replace the flow (size, size, 2) where the face's triangles are in front."""
    size, count = flow.shape[0], layout.vertices
    vertices, faces = points[:count], layout.detail_faces
    faces = faces[(vertices[faces, 2] < FAR).all(axis=1)]
    if not len(faces):
        return
    limit = np.where(depth == EMPTY_DEPTH, np.float32(FAR), depth + np.float32(BEHIND))
    hidden: Array = np.asarray(cv2.resize(limit, (size, size), interpolation=cv2.INTER_NEAREST))
    places, seen = rows[:count, -PLACE_SIZE:-1], rows[:count, -1]

    taken = _carry(flow, vertices, faces, places, seen == SEEN, hidden)
    mirrored = seen == SEEN_MIRRORED
    if mirrored[faces].any():
        hidden[taken] = -FAR
        _carry(flow, vertices, faces, places[layout.mirror[:count]], mirrored, hidden)


def _carry(
    flow: Array,
    vertices: Array,
    faces: NDArray[np.int32],
    places: Array,
    shown: NDArray[np.bool_],
    hidden: Array,
) -> NDArray[np.bool_]:
    """Flow to the vertices' places where shown ones are in front of ``hidden``; returns where."""
    values = np.empty_like(vertices)
    values[:, :2] = (places - vertices[:, :2]) / (2 * LARGEST_FLOW) + 0.5
    values[:, 2] = shown
    image, front = rasterise(vertices, faces, np.clip(values, 0, 1), flow.shape[0])
    found = (image[..., 2] > 0.5) & (front < hidden)
    flow[found] = (image[found, :2] - 0.5) * (2 * LARGEST_FLOW)
    return np.asarray(found)


def reach_of(depth: Array, warped: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(size, size) uint8: 255 where points lie or the carried portrait shows the person.

    Beyond the edge of a portrait nothing is known. Training pictures end there as well, so the
    network was never told to leave it empty.
    """
    drawn = (depth > EMPTY_DEPTH).astype(np.uint8) * 255
    closed = cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, CLOSING)
    size = warped.shape[0]
    points = cv2.resize(closed, (size, size), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.maximum(points, cv2.dilate(warped[..., 3], SOFT_EDGE)), np.uint8)
