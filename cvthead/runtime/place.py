"""What a frame shows where: the driven points splatted, and the portrait carried along.

A descriptor per point cannot hold every hair and pore. But each point knows where the portrait
shows it, so the splat also gives a flow from the driven frame back to the portrait; read through
it, the portrait is a sharp first guess of everything the source saw. The face, whose lids, irises
and lips move by less than a pixel of the splat, gets its flow from its triangles at full
resolution (cvthead/runtime/face.py). What shows a second time where it no longer is
(cvthead/runtime/ghosts.py) is taken out, and so is the portrait's outline where it has come to lie
within the person (cvthead/runtime/seams.py).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.points import SEEN, PointLayout
from cvthead.runtime.face import carried_face, without_covered
from cvthead.runtime.fill import FILL_LEVELS, ZERO, fill
from cvthead.runtime.ghosts import ghosts
from cvthead.runtime.lend import hidden_share
from cvthead.runtime.seams import seams
from cvthead.runtime.splat import EMPTY_DEPTH, splat
from cvthead.runtime.triangles import FAR
from cvthead.runtime.warp import dense_flow, warp

Array = NDArray[np.float32]
Codes = NDArray[np.uint8]

DEPTH_RANGE = 1.5  # normalised depths of a head in its crop lie well within -1.5..1.5
COLOURS = slice(1, 4)  # of the codes, after the depth
CODE_STEPS = 127  # codes of a range on either side of ZERO
CLOSING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))  # closes gaps between points
SOFT_EDGE = np.ones((3, 3), np.uint8)
# Of the portrait, where it shows no person; four bytes at once.
NOBODY = np.array([ZERO, ZERO, ZERO, 0], np.uint8).view(np.uint32)
BEHIND = 0.06  # normalised depth, about 10 mm: further back a triangle lies behind the splat


class Placed(NamedTuple):
    """What the frame network reads, and what its answer is mixed with.

    Attributes:
        codes: (s, s, :func:`code_size`) uint8: depth and descriptors with holes filled, how the
            portrait sees the point, coverage at three scales.
        warped: (2s, 2s, 4) uint8, the portrait carried to the driven pose.
        reach: (2s, 2s) uint8, highest alpha; see :func:`reach_of`.
        lent: (s, s) of cvthead.runtime.lend.hidden_share.
        part: (s, s) of cvthead.runtime.fill.Filled.
    """

    codes: Codes
    warped: Codes
    reach: Codes
    lent: Array
    part: Array

    def without_lending(self) -> Placed:
        """For the transformer alone, which chooses all colours itself: an ablation."""
        return self._replace(lent=np.zeros_like(self.lent))


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
    face = carried_face(layout, points, places, 2 * size)
    owner = splat(without_covered(layout, points, face.depth), size).ravel()
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
    limit = np.where(known, depth + np.float32(BEHIND), np.float32(FAR))
    limit = cv2.resize(limit, flow.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    refined = face.known & (face.depth < limit)
    cv2.copyTo(face.flow, refined.view(np.uint8), flow)
    warped = warp(portrait, flow)
    take_out(warped, ghost, seam, refined)
    codes = np.empty((size, size, code_size(descriptors.shape[1])), np.uint8)
    filled = fill(values.reshape(size, size, -1), known)
    codes[..., : -FILL_LEVELS - 1] = filled.values
    codes[..., -FILL_LEVELS - 1] = np.rint(seen * 255)
    codes[..., -FILL_LEVELS:] = filled.coverage
    # Nothing is lent to what is seen, nor to eyes and mouth: the frame network has seen many open
    # that were shut in the portrait, so it knows better than the colours around.
    sure = seen == SEEN
    sure.ravel()[drawn] |= layout.inner[front]
    share = hidden_share(sure, known)
    return Placed(codes, warped, reach_of(covered, warped), share, filled.part)


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


def reach_of(covered: Codes, warped: Codes) -> Codes:
    """(2s, 2s) uint8: 255 where points lie, 1 in (s, s), or the carried portrait shows the person.

    Beyond the edge of a portrait nothing is known. Training pictures end there as well, so but for
    imagined views the network was never told to leave it empty.
    """
    size = warped.shape[0]
    points = cv2.resize(covered * np.uint8(255), (size, size), interpolation=cv2.INTER_LINEAR)
    person = cv2.dilate(cv2.extractChannel(warped, 3), SOFT_EDGE)
    return np.asarray(cv2.max(points, person), np.uint8)
