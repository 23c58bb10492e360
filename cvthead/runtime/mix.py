"""The frame network's codes -> the picture: warped pixels and painted ones, mixed by its gate."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.runtime.edges import continued
from cvthead.runtime.holes import without_holes
from cvthead.runtime.lend import lend
from cvthead.runtime.place import COLOURS, Placed
from cvthead.runtime.subpixels import shuffled

Codes = NDArray[np.uint8]

GATES = 4  # where they begin among the 32-bit numbers
# The network gives mask and gate as logits in -LOGIT_RANGE..LOGIT_RANGE.
LOGIT_RANGE = 8.0
SIGMOID = np.reciprocal(1 + np.exp(LOGIT_RANGE * (1 - np.arange(256) / 127.5)))
ALPHA = np.rint(255 * SIGMOID).astype(np.uint8)
GATE = SIGMOID.astype(np.float32)
# Symmetric filter: 0 at the finest pattern that pixels can show, flat at coarse ones.
EVEN = (-1 / 16, 4 / 16, 10 / 16, 4 / 16, -1 / 16)
LINE = np.array(EVEN, np.float32)


def mix(codes: Codes, placed: Placed) -> Codes:
    """One frame.

    Args:
        codes: (s, s, 20) of the network: RGB and mask of each of a block's pixels, then the
            pixels' gates.
        placed: what the network was given.

    Returns:
        (2s, 2s, 4) RGBA; beyond the person and in its holes, colours go on as
        cvthead.runtime.edges says.
    """
    fours = codes.view(np.uint32)  # a block's four pixels, then its four gates
    pixels = shuffled(np.ascontiguousarray(fours[..., :GATES]))
    painted = evened(pixels.view(np.uint8).reshape(placed.warped.shape))
    alpha = cv2.LUT(cv2.extractChannel(painted, 3), ALPHA)
    gates = shuffled(np.ascontiguousarray(fours[..., GATES:]).view(np.uint8))
    gate = np.asarray(cv2.LUT(evened(gates), GATE), np.float32)
    return composed(painted, np.asarray(alpha, np.uint8), gate, placed)


def composed(painted: Codes, alpha: Codes, gate: NDArray[np.float32], placed: Placed) -> Codes:
    """The frame of what is painted and what is carried.

    Args:
        painted: (2s, 2s, 4) of which RGB counts; alpha: (2s, 2s); gate: (2s, 2s) 0..1, how far the
            carried portrait is shown instead.
        placed: what the network was given.

    Returns:
        (2s, 2s, 4) as :func:`mix`.
    """
    painted = lend(painted, placed.codes[..., COLOURS], placed.lent, placed.part)
    out = cv2.blendLinear(placed.warped, painted, gate, 1 - gate)
    alpha = np.asarray(cv2.min(alpha, placed.reach), np.uint8)  # beyond it no network is asked
    cv2.insertChannel(alpha, out, 3)
    out = continued(np.asarray(out, np.uint8))
    cv2.insertChannel(without_holes(alpha, placed.reach), out, 3)
    return out


def evened(image: NDArray[np.generic]) -> Codes:
    """(s, s) or (s, s, C), filtered as cvthead.model.light_unet.even does."""
    return np.asarray(cv2.sepFilter2D(image, -1, LINE, LINE), np.uint8)  # type: ignore[arg-type]
