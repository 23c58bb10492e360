"""What a frame shows where: the driven points splatted, and the portrait carried along.

A descriptor per point cannot hold every hair and pore. But each point knows where the portrait
shows it, so the splat also gives a flow from the driven frame back to the portrait; read through
it, the portrait is a sharp first guess of everything the source saw. The face, whose lids, irises
and lips move by less than a pixel of the splat, gets its flow from its triangles at full
resolution. What of it the portrait hides is taken from the other side, if that is seen. What shows
a second time where it no longer is (cvthead/runtime/ghosts.py) is taken out, and so is the
portrait's outline where it has come to lie within the person (cvthead/runtime/seams.py).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.points import PointLayout
from cvthead.runtime.fill import FILL_LEVELS, ZERO, fill
from cvthead.runtime.ghosts import ghosts
from cvthead.runtime.seams import seams
from cvthead.runtime.splat import EMPTY_DEPTH, splat
from cvthead.runtime.triangles import FAR, rasterise
from cvthead.runtime.warp import dense_flow, warp

Array = NDArray[np.float32]
Codes = NDArray[np.uint8]

SEEN, SEEN_MIRRORED = 1.0, 0.5  # by the portrait; only the point across the face is; else 0
DEPTH_RANGE = 1.5  # normalised depths of a head in its crop lie well within -1.5..1.5
CODE_STEPS = 127  # codes of a range on either side of ZERO
CLOSING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))  # closes gaps between points
SOFT_EDGE = np.ones((3, 3), np.uint8)
# Of the portrait, where it shows no person; four bytes at once.
NOBODY = np.array([ZERO, ZERO, ZERO, 0], np.uint8).view(np.uint32)
BEHIND = 0.06  # normalised depth, about 10 mm: further back a triangle lies behind the splat
LARGEST_FLOW = 2.0  # normalised: twice the picture's half width


class Placed(NamedTuple):
    """What the frame network reads, and what its answer is mixed with.

    Attributes:
        codes: (s, s, :func:`code_size`) uint8: depth and descriptors with holes filled, how the
            portrait sees the point, coverage at three scales.
        warped: (2s, 2s, 4) uint8, the portrait carried to the driven pose.
        reach: (2s, 2s) uint8, highest alpha; see :func:`reach_of`.
    """

    codes: Codes
    warped: Codes
    reach: Codes


def code_size(descriptor_size: int) -> int:
    """Channels of Placed.codes."""
    return 1 + descriptor_size + 1 + FILL_LEVELS


def place(
    layout: PointLayout,
    points: Array,
    places: Array,
    owners: NDArray[np.int32],
    rim: Array,
    descriptors: Codes,
    portrait: Codes,
    size: int,
) -> Placed:
    """Splat the descriptors and carry the portrait's pixels to the driven points.

    Args:
        layout: numbering of the points.
        points: (P, 3) normalised driven projections.
        places: (P, 3) each point's x and y in the portrait and how it is seen.
        owners: of cvthead.runtime.ghosts.point_owners.
        rim: of cvthead.runtime.seams.outline_rim.
        descriptors: (P, C) codes; C may be 0.
        portrait: (256, 256, 4), see Avatar.
        size: of the splat, half of the frame's.
    """
    owner = splat(points, size).ravel()
    drawn = np.flatnonzero(owner >= 0)
    front = owner[drawn]
    # Gathered together, for gathering is what costs: flow, seen, depth.
    towards = places - points  # all three columns, for two of them would take ten times as long
    table = np.concatenate([towards[:, :2], places[:, 2:], points[:, 2:]], axis=1)
    gathered = table.take(front, axis=0)
    values = np.zeros((size * size, 1 + descriptors.shape[1]), np.uint8)
    values[drawn] = np.concatenate(
        [coded(gathered[:, 3:], DEPTH_RANGE), descriptors.take(front, axis=0)], axis=1
    )
    image = np.zeros((size * size, 4), np.float32)
    image[:, 3] = EMPTY_DEPTH
    image[drawn] = gathered
    planes = cv2.split(image.reshape(size, size, 4))
    x, y, seen, depth = (np.asarray(plane, np.float32) for plane in planes)

    flow = dense_flow(x, y, (seen == SEEN).astype(np.float32), 2 * size)
    small = np.asarray(cv2.resize(flow, (size, size), interpolation=cv2.INTER_AREA), np.float32)
    known = depth > EMPTY_DEPTH
    covered: Codes = np.asarray(
        cv2.morphologyEx(known.view(np.uint8), cv2.MORPH_CLOSE, CLOSING), np.uint8
    )
    ghost = ghosts(small, towards, owners, covered > 0)
    seam = seams(small, rim, covered)
    refined = _refine(flow, layout, points, places, depth)
    warped = warp(portrait, flow)
    take_out(warped, ghost, seam, refined)
    codes = np.empty((size, size, code_size(descriptors.shape[1])), np.uint8)
    filled, codes[..., -FILL_LEVELS:] = fill(values.reshape(size, size, -1), known)
    codes[..., : filled.shape[2]] = filled
    codes[..., filled.shape[2]] = np.rint(seen * 255)
    return Placed(codes, warped, reach_of(covered, warped))


def coded(values: Array, largest: float) -> Codes:
    """-largest..largest -> 1..255, 0 -> ZERO."""
    steps = np.rint(values * np.float32(CODE_STEPS / largest)).clip(-CODE_STEPS, CODE_STEPS)
    return np.asarray(steps + ZERO, np.uint8)


def take_out(warped: Codes, ghost: Array, seam: Array, kept: NDArray[np.bool_]) -> None:
    """Blend the carried portrait (2s, 2s, 4) with nobody as far as a ghost or a seam (s, s) says;
    what is surely kept (2s, 2s) is no ghost."""
    if not (ghost.any() or seam.any()):
        return
    sides = warped.shape[1::-1]
    gone = cv2.resize(ghost, sides, interpolation=cv2.INTER_LINEAR) * ~kept
    gone = np.maximum(gone, cv2.resize(seam, sides, interpolation=cv2.INTER_LINEAR))
    nobody = np.full(warped.shape[:2], NOBODY).view(np.uint8).reshape(warped.shape)
    cv2.blendLinear(warped, nobody, 1 - gone, gone, warped)


def _refine(
    flow: Array, layout: PointLayout, points: Array, places: Array, depth: Array
) -> NDArray[np.bool_]:
    """Replace the flow (size, size, 2) where the face's triangles are in front: (size, size)."""
    size, own = flow.shape[0], layout.detail_vertices
    corners, faces = points[own], layout.detail_faces
    away = _votes(corners[:, 2] >= FAR, faces) > 0
    if away.any():
        faces = faces[~away]
    if not len(faces):
        return np.zeros((size, size), np.bool_)
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

    image, front = rasterise(corners, faces, values, size)
    limit = np.where(depth == EMPTY_DEPTH, np.float32(FAR), depth + np.float32(BEHIND))
    hidden = cv2.resize(limit, (size, size), interpolation=cv2.INTER_NEAREST)
    found = (cv2.extractChannel(image, 2) > np.float32(0.5)) & (front < hidden)
    image -= np.float32(0.5)
    image *= np.float32(2 * LARGEST_FLOW)
    carried = np.empty_like(flow)
    cv2.mixChannels([image], [carried], [0, 0, 1, 1])
    cv2.copyTo(carried, found.view(np.uint8), flow)
    return np.asarray(found)


def _votes(chosen: NDArray[np.bool_], faces: NDArray[np.int32]) -> NDArray[np.uint8]:
    """How many corners of each face (F, 3) are among the chosen vertices, 0 to 3."""
    first, second, third = faces.T
    counted = chosen.view(np.uint8)
    return np.asarray(counted[first] + counted[second] + counted[third])


def reach_of(covered: Codes, warped: Codes) -> Codes:
    """(2s, 2s) uint8: 255 where points lie, 1 in (s, s), or the carried portrait shows the person.

    Beyond the edge of a portrait nothing is known. Training pictures end there as well, so but for
    imagined views the network was never told to leave it empty.
    """
    size = warped.shape[0]
    points = cv2.resize(covered * np.uint8(255), (size, size), interpolation=cv2.INTER_LINEAR)
    person = cv2.dilate(cv2.extractChannel(warped, 3), SOFT_EDGE)
    return np.asarray(cv2.max(points, person), np.uint8)
