"""Holes of a splat, filled as cvthead/model/fill.py does, on 8-bit codes."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Codes = NDArray[np.uint8]
Array = NDArray[np.float32]

FILL_LEVELS = 3
ZERO = 128  # the code of 0


class Filled(NamedTuple):
    """A splat without holes.

    Attributes:
        values: (s, s, C) codes.
        coverage: (s, s, 3) of each level's blocks, 0..255.
        part: (s, s) 0..1, how far the values are those of pixels that are known; the rest is ZERO.
    """

    values: Codes
    coverage: Codes
    part: Array


def fill(values: Codes, known: NDArray[np.bool_]) -> Filled:
    """A hole takes the average of what its 2, 4, 8 pixel block knows, or ZERO.

    Args:
        values: (s, s, C) codes, 0 where not known; s is a multiple of 8.
        known: (s, s).
    """
    size = known.shape[0]
    total, count = values.astype(np.uint16), known.astype(np.uint16)
    pulled: list[tuple[Array, NDArray[np.bool_]]] = []
    coverage = np.empty((size, size, FILL_LEVELS), np.uint8)
    for level in range(FILL_LEVELS):
        total, count = _quarters(total), _quarters(count)
        share = np.rint(count * np.float32(255 / 4 ** (level + 1))).astype(np.uint8)
        coverage[..., level] = cv2.resize(share, (size, size), interpolation=cv2.INTER_LINEAR)
        share_inverse = np.reciprocal(np.maximum(count, 1).astype(np.float32))
        mean: Array = np.asarray(total * share_inverse[..., None], np.float32)
        pulled.append((mean, (count > 0)[..., None]))
    out = np.full_like(mean, ZERO)
    part: Array = np.zeros(mean.shape[:2], np.float32)
    for mean, some in reversed(pulled):
        sides = mean.shape[:2]
        coarse = cv2.resize(out, sides, interpolation=cv2.INTER_LINEAR)
        out = np.where(some, mean, coarse.reshape(mean.shape))
        part = np.maximum(_resized(part, sides), some[..., 0].astype(np.float32))
    small = np.rint(out).astype(np.uint8)
    large = cv2.resize(small, (size, size), interpolation=cv2.INTER_LINEAR)
    filled = cv2.copyTo(values, known.view(np.uint8), large.reshape(values.shape))
    part = np.maximum(_resized(part, known.shape), known.astype(np.float32))
    return Filled(np.asarray(filled, np.uint8), coverage, part)


def _resized(part: Array, sides: tuple[int, ...]) -> Array:
    return np.asarray(cv2.resize(part, sides, interpolation=cv2.INTER_LINEAR), np.float32)


def _quarters(a: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Sums over blocks of two by two; 64 codes fit in 16 bits."""
    rows = a[::2] + a[1::2]
    return np.asarray(rows[:, ::2] + rows[:, 1::2])
