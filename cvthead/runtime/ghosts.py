"""Where the carried portrait shows something that has moved elsewhere.

Between the points and beyond the outline the flow is guessed from the points around. When the head
turns far, that repeats hair, an eye or a collar beside the place where the points show them. But
each pixel of the portrait belongs to the nearest point that the portrait sees, and where that point
has gone is known.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.runtime.nearest import nearest_pixels
from cvthead.runtime.warp import reading_place

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

OWNER_PIXELS = 128  # of the portrait's side: finer than the points lie
# Normalised: 9 pixels of 256, which a stretched surface strays between neighbouring points; and 4
# beside all points, where the flow of the outline goes on. What strays by SURE times as much is
# gone altogether; in between it fades, or it would flicker in motion.
TOLERANCE, TOLERANCE_OUTSIDE = 0.07, 0.03
SURE = 1.5
SPECK = np.ones((2, 2), np.uint8)  # single pixels are errors of the grid


def point_owners(places: Array, seen: Mask) -> NDArray[np.int32]:
    """The point that each pixel of the portrait belongs to; depends on the portrait alone.

    Args:
        places: (P, 2+) each point's normalised x and y in the portrait.
        seen: (P,) which of them the portrait sees.

    Returns:
        (OWNER_PIXELS, OWNER_PIXELS) number of the nearest seen point; -1 if none is seen, or all
        are: the ablation that takes hidden points as seen does not know what lies in front.
    """
    size = OWNER_PIXELS
    point = np.full((size, size), -1, np.int32)
    if seen.all() or not seen.any():
        return point
    numbers = np.flatnonzero(seen)
    column, row = _pixels(places[numbers, 0], size), _pixels(places[numbers, 1], size)
    point[row, column] = numbers
    return point.ravel()[nearest_pixels(point >= 0)]


def ghosts(flow: Array, towards: Array, owners: NDArray[np.int32], covered: Mask) -> Array:
    """How surely each pixel's piece of the portrait has moved elsewhere.

    Args:
        flow: (s, s, 2) from each pixel of the frame to the portrait, normalised.
        towards: (P, 2+) from each driven point to its place in the portrait, normalised.
        owners: of :func:`point_owners`.
        covered: (s, s) where points lie.

    Returns:
        (s, s), 0..1.
    """
    if owners[0, 0] < 0:
        return np.zeros(flow.shape[:2], np.float32)
    asked = towards.take(owners.ravel(), axis=0).reshape(*owners.shape, -1)
    meant = cv2.remap(  # type: ignore[call-overload]
        asked,
        reading_place(flow, len(owners)),
        None,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    )
    # Further columns of ``towards`` are carried along, for to cut them off would cost more.
    x, y = (cv2.subtract(*pair) for pair in zip(cv2.split(flow), cv2.split(meant), strict=False))
    strict = np.where(covered, np.float32(TOLERANCE**-2), np.float32(TOLERANCE_OUTSIDE**-2))
    beyond = (x * x + y * y) * strict - np.float32(1)
    lost = (beyond * np.float32(1 / (SURE**2 - 1))).clip(0, 1)
    # Two steps, for MORPH_OPEN would shift the rest by a pixel.
    return np.asarray(cv2.dilate(cv2.erode(lost, SPECK), SPECK, anchor=(0, 0)), np.float32)


def _pixels(coordinates: Array, size: int) -> NDArray[np.intp]:
    """Normalised -> number of the pixel, those beyond the border moved to it."""
    place = (coordinates + np.float32(1)) * np.float32(size / 2)
    return place.astype(np.intp).clip(0, size - 1)
