"""The portrait's pixels at the driven pose: cvthead/model/warp.py in OpenCV, several times faster
than the same operations in a network runtime."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

FLOW_LEVELS = 4
EPSILON = 1e-4


def dense_flow(x: Array, y: Array, seen: Array, size: int) -> Array:
    """Splatted flow x and y (s, s), valid where seen (s, s) is 1 -> (size, size, 2), no holes."""
    weighted = cv2.merge([x * seen, y * seen, seen])
    # Averages of what is known among nine pixels; the third channel becomes 1 where anything is.
    near: Array = np.asarray(cv2.blur(weighted, (3, 3), borderType=cv2.BORDER_CONSTANT))
    levels = [_means(near)]
    pulled = levels[0]
    for _ in range(FLOW_LEVELS):
        half = pulled.shape[0] // 2
        pulled = np.asarray(cv2.resize(pulled, (half, half), interpolation=cv2.INTER_AREA))
        levels.append(pulled)
    dense = _means(levels[-1])
    for level in reversed(levels[:-1]):
        known = _means(level)
        side = level.shape[0]
        coarse = np.asarray(cv2.resize(dense, (side, side), interpolation=cv2.INTER_LINEAR))
        some = (cv2.extractChannel(level, 2) > 0).view(np.uint8)
        dense = np.asarray(cv2.copyTo(known, some, coarse))
    out = np.empty((size, size, 2), np.float32)
    full = np.asarray(cv2.resize(dense, (size, size), interpolation=cv2.INTER_LINEAR))
    cv2.mixChannels([full], [out], [0, 0, 1, 1])
    return out


def _means(sums: Array) -> Array:
    """(s, s, 3) weighted x and y and weight -> x, y, and 1 where the weight is above 0."""
    x, y, weight = cv2.split(sums)
    share = np.maximum(weight, np.float32(EPSILON))
    some = (weight > 0).astype(np.float32)
    return np.asarray(cv2.merge([x / share, y / share, some]))


def reading_place(flow: Array, side: int) -> Array:
    """Where each pixel reads the portrait: flow (s, s, 2), normalised -> (s, s, 2) x and y as
    OpenCV counts pixels of a portrait of that side, the centre of the first being 0."""
    size = flow.shape[0]
    line = (np.arange(size, dtype=np.float32) + 0.5) * np.float32(side / size) - np.float32(0.5)
    place = flow * np.float32(side / 2)
    place[..., 0] += line
    place[..., 1] += line[:, None]
    return place


def warp(portrait: NDArray[np.uint8], flow: Array) -> NDArray[np.uint8]:
    """Portrait (s, s, 4) read at pixel centre + flow (size, size, 2), bilinear."""
    place = reading_place(flow, portrait.shape[0])
    out = cv2.remap(  # type: ignore[call-overload]
        portrait, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(out, np.uint8)
