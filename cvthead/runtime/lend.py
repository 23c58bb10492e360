"""What the portrait hides is painted in the colours of its points.

They are the best guess there is (cvthead/hidden.py). The frame network, which hardly ever saw the
truth there, tinted them; so where no point is seen it paints only what is finer than two pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Codes = NDArray[np.uint8]

AROUND = 7  # pixels of the splat over which seen points are counted
SURE = 0.8  # share of the points from which a place counts as seen


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


def lend(painted: Codes, colours: Codes, share: Array) -> Codes:
    """Give what is hidden the points' colours, at half the resolution.

    Args:
        painted: (2s, 2s, 4) RGB and mask.
        colours: (s, s, 3) codes of the points' colours.
        share: (s, s) of :func:`hidden_share`.

    Returns:
        (2s, 2s, 4), the mask as it was.
    """
    if not share.any():
        return painted
    small = cv2.resize(painted, share.shape[::-1], interpolation=cv2.INTER_AREA)
    off = np.zeros(small.shape, np.float32)
    # A code is half a step above the byte of the same colour.
    off[..., :3] = (colours - np.float32(0.5) - small[..., :3]) * share[..., None]
    everywhere = cv2.resize(off, painted.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.add(painted, everywhere, dtype=cv2.CV_8U), np.uint8)
