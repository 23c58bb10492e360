"""Pixels that weigh more in training: eyes and mouth, few but where people look first; and what the
source hides, which is rare and hardest."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.runtime.place import Placed

Array = NDArray[np.float32]

# Outlines among the 478 face-mesh landmarks.
RIGHT_EYE = (33, 246, 161, 160, 159, 158, 157, 173, 133, 155, 154, 153, 145, 144, 163, 7)
LEFT_EYE = (263, 466, 388, 387, 386, 385, 384, 398, 362, 382, 381, 380, 374, 373, 390, 249)
LIPS = (61, 185, 40, 39, 37, 0, 267, 269, 270, 409, 291, 375, 321, 405, 314, 17, 84, 181, 91, 146)
# Further weight of a pixel, beside the 1 that each has.
WEIGHTS = {RIGHT_EYE: 8.0, LEFT_EYE: 8.0, LIPS: 4.0}
MARGIN = 0.012  # of the picture's side, added around each outline
ZOOMED = (RIGHT_EYE + LEFT_EYE, LIPS)
UNSEEN_WEIGHT = 3.0  # further weight, as well
GAP = np.ones((9, 9), np.uint8)
SEEN_CODE = 1  # in Placed.codes without descriptors: after the depth
ZOOM_SIDE = 0.375  # of the picture's side


def detail_weights(landmarks: Array, size: int) -> Array:
    """(size, size) weight of each pixel, 1 outside of eyes and mouth.

    Args:
        landmarks: (478, 2) or (478, 3) normalised.
        size: of the picture.
    """
    pixels = _pixels(landmarks, size)
    weights = np.ones((size, size), np.float32)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(MARGIN * size) + 1,) * 2)
    for outline, weight in WEIGHTS.items():
        inside = np.zeros((size, size), np.uint8)
        cv2.fillPoly(inside, [np.rint(pixels[list(outline)]).astype(np.int32)], 1)
        weights = np.maximum(weights, 1 + weight * cv2.dilate(inside, kernel))
    return np.asarray(weights, np.float32)


def unseen_weights(placed: Placed) -> Array:
    """(2s, 2s) weight of each pixel, 1 beside the head and where the source sees what is there."""
    size = placed.reach.shape[::-1]
    seen = cv2.resize(placed.codes[..., SEEN_CODE], size, interpolation=cv2.INTER_NEAREST)
    hidden = ((seen == 0) & (placed.reach > 0)).astype(np.uint8)
    # Between the points of a seen surface are gaps; they are thin.
    wide = cv2.morphologyEx(hidden, cv2.MORPH_OPEN, GAP)
    return 1 + np.float32(UNSEEN_WEIGHT) * wide.astype(np.float32)


def zoom_corner(landmarks: Array, part: int, size: int) -> tuple[int, int]:
    """Top and left of the square, ZOOM_SIDE of the picture wide, around a part of ZOOMED."""
    side = round(ZOOM_SIDE * size)
    x, y = _pixels(landmarks, size)[list(ZOOMED[part])].mean(0)
    top, left = (int(np.clip(round(v - side / 2), 0, size - side)) for v in (y, x))
    return top, left


def _pixels(landmarks: Array, size: int) -> Array:
    return np.asarray((np.clip(landmarks[:, :2], -4, 4) * 0.5 + 0.5) * size, np.float32)
