"""What the U-Net painted, as pictures."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.frame import Frame

HARD_MASK = 0.6
# tanh(x) for RGB; the mask's sigmoid(x) is (1 + tanh(x / 2)) / 2.
SLOPES = np.array([1, 1, 1, 0.5], np.float32)

Array = NDArray[np.float32]
Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Painted:
    """The U-Net's output.

    Attributes:
        raw: (256, 256, 4) RGB before tanh and mask before sigmoid.
    """

    raw: Array

    def frame(self) -> Frame:
        """Colour and alpha, rounded."""
        codes = np.tanh(self.raw * SLOPES)
        codes += 1
        codes *= 127.5
        # Rounds halves to even and stays within 0..255.
        return Frame.of_rgba(np.asarray(cv2.convertScaleAbs(codes), np.uint8))

    def mask(self) -> Array:
        """(256, 256) the head's share of each pixel, 0 to 1."""
        return np.asarray(0.5 * (np.tanh(self.raw[..., 3] * SLOPES[3]) + 1))

    def over_white(self, threshold: float | None = None) -> Image:
        """The painted head over white, as the released code writes it.

        Args:
            threshold: None blends by the mask; a number (HARD_MASK) cuts it there first.

        Returns:
            (256, 256, 3) uint8; truncated, not rounded.
        """
        share = 0.5 * (np.tanh(self.raw * SLOPES) + 1)
        colour, mask = share[..., :3], share[..., 3:]
        if threshold is not None:
            mask = (mask > threshold).astype(np.float32)
        return np.asarray((colour * mask + (1 - mask)) * 255, np.uint8)
