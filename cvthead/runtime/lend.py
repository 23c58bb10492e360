"""What the portrait hides is painted in the colours of its points.

They are the best guess there is (cvthead/hidden.py). The frame network, which hardly ever saw the
truth there, tinted them; so where no point is seen it paints only what is finer than two pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.runtime.fill import ZERO

Array = NDArray[np.float32]
Codes = NDArray[np.uint8]

AROUND = 7  # pixels of the splat over which seen points are counted
SURE = 0.8  # share of the points from which a place counts as seen
LEAST = np.float32(0.25)  # part of a colour that is a point's, from which all of it is lent


def hidden_share(seen: NDArray[np.bool_], known: NDArray[np.bool_]) -> Array:
    """How far each pixel of a splat is hidden.

    Args:
        seen: (s, s) the portrait sees the pixel's point.
        known: (s, s) there is a point.

    Returns:
        (s, s) 0..1, 1 where none of the points around is seen, 0 from SURE of them on. It is 1
        beyond all points as well: the colours there are those of the nearest ones.
    """
    window = (AROUND, AROUND)
    shown, there = (
        cv2.blur(each.astype(np.float32), window, borderType=cv2.BORDER_CONSTANT)
        for each in (seen & known, known)
    )
    return np.asarray(1 - np.minimum(shown / (np.maximum(there, 1e-6) * np.float32(SURE)), 1))


def lend(painted: Codes, colours: Codes, share: Array, part: Array) -> Codes:
    """Give what is hidden the points' colours, at half the resolution.

    Args:
        painted: (2s, 2s, 4) RGB and mask.
        colours: (s, s, 3) codes of the points' colours, holes filled.
        share: (s, s) of :func:`hidden_share`.
        part: (s, s) of cvthead.runtime.fill.Filled: without the grey that fills wide holes, the
            colours are those of the nearest points; where hardly any is near, nothing is lent.

    Returns:
        (2s, 2s, 4), the mask as it was.
    """
    if not share.any():
        return painted
    small = cv2.resize(painted, share.shape[::-1], interpolation=cv2.INTER_AREA)
    off = np.zeros(small.shape, np.float32)
    pure = (colours - np.float32(ZERO)) / np.maximum(part, LEAST)[..., None] + np.float32(ZERO)
    # A code is half a step above the byte of the same colour.
    pure = np.clip(pure - np.float32(0.5), 0, 255)
    off[..., :3] = (pure - small[..., :3]) * (share * np.minimum(part / LEAST, 1))[..., None]
    everywhere = cv2.resize(off, painted.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.add(painted, everywhere, dtype=cv2.CV_8U), np.uint8)
