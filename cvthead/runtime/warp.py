"""The portrait's pixels at the driven pose: cvthead/model/warp.py in OpenCV, several times faster
than the same operations in a network runtime."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

FLOW_LEVELS = 4
EPSILON = 1e-4
THREE = np.ones((3, 3), np.uint8)


def dense_flow(flow: Array, seen: Array, size: int) -> Array:
    """Splatted flow (s, s, 2), valid where seen (s, s) is 1 -> (size, size, 2), no holes."""
    weighted = np.dstack([flow * seen[..., None], seen])
    smooth = cv2.blur(weighted, (3, 3), borderType=cv2.BORDER_CONSTANT)
    share = np.maximum(smooth[..., 2:], EPSILON)
    near = cv2.dilate(seen, THREE, borderType=cv2.BORDER_CONSTANT, borderValue=0)[..., None]
    levels = [np.concatenate([smooth[..., :2] / share * near, near], axis=-1)]
    for _ in range(FLOW_LEVELS):
        half = levels[-1].shape[0] // 2
        levels.append(
            np.asarray(cv2.resize(levels[-1], (half, half), interpolation=cv2.INTER_AREA))
        )
    dense = levels[-1][..., :2] / np.maximum(levels[-1][..., 2:], EPSILON)
    for level in reversed(levels[:-1]):
        coarse = cv2.resize(dense, level.shape[:2], interpolation=cv2.INTER_LINEAR)
        known = level[..., :2] / np.maximum(level[..., 2:], EPSILON)
        dense = np.where(level[..., 2:] > 0, known, coarse)
    return np.asarray(cv2.resize(dense, (size, size), interpolation=cv2.INTER_LINEAR), np.float32)


def warp(portrait: NDArray[np.uint8], flow: Array) -> NDArray[np.uint8]:
    """Portrait (s, s, 4) read at pixel centre + flow (size, size, 2), bilinear."""
    side, size = portrait.shape[0], flow.shape[0]
    # Normalised -> pixel index: centre of the first pixel is 0 for OpenCV.
    line = (np.arange(size, dtype=np.float32) + 0.5) * np.float32(side / size) - np.float32(0.5)
    place = flow * np.float32(side / 2)
    place[..., 0] += line
    place[..., 1] += line[:, None]
    out = cv2.remap(  # type: ignore[call-overload]
        portrait, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(out, np.uint8)
