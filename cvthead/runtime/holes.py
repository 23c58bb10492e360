"""Holes inside the person, where points lie all over: the background does not show there.

Far from the portrait's pose a few pixels beside jaw and neck are carried by nothing, painted from
points far apart, and the network's mask now and then leaves them out.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Codes = NDArray[np.uint8]

OPEN = 128  # alpha below which a pixel may belong to a hole
REACHED = 250  # of the highest alpha: points lie there
EDGE = 3  # pixels of soft edge around a hole
BEYOND = 3  # pixels around those that say what the hole is filled with
DARKEST = 10  # percent of them may be less than it is filled with
INNER, OUTER = (
    cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * each + 1,) * 2)
    for each in (EDGE, EDGE + BEYOND)
)


def without_holes(alpha: Codes, reach: Codes) -> Codes:
    """Alpha (s, s) with the person's holes filled with what surrounds them, but for those that
    points leave free.

    Args:
        alpha: of the frame.
        reach: (s, s) highest alpha, see cvthead.runtime.place.reach_of.
    """
    low = cv2.inRange(alpha, 0, OPEN - 1)
    _, label, boxes, _ = cv2.connectedComponentsWithStats(low, connectivity=4)
    size, out = len(alpha), alpha
    for number in range(1, len(boxes)):
        left, top, width, height = boxes[number, :4]
        if left == 0 or top == 0 or left + width == size or top + height == size:
            continue
        around = tuple(
            slice(max(0, start - EDGE - BEYOND), start + length + EDGE + BEYOND)
            for start, length in ((top, height), (left, width))
        )
        hole = (label[around] == number).view(np.uint8)
        if (reach[around][hole > 0] < REACHED).any():
            continue
        inner, outer = cv2.dilate(hole, INNER), cv2.dilate(hole, OUTER)
        level = int(np.percentile(alpha[around][outer > inner], DARKEST))
        if out is alpha:
            out = alpha.copy()
        filled = np.minimum(inner * np.uint8(level), reach[around])
        out[around] = np.maximum(out[around], filled)
    return out
