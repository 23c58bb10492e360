"""A rendered frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Frame:
    """What the U-Net painted.

    Attributes:
        rgb: (256, 256, 3) uint8; meaningless where alpha is 0.
        alpha: (256, 256) uint8 foreground mask.
    """

    rgb: Image
    alpha: Image

    def over(self, background: tuple[int, int, int] | Image) -> Image:
        """(256, 256, 3) uint8: the head over a colour or an image of the same size."""
        alpha = cv2.merge([self.alpha] * 3)
        # Every picture pays for this. Whole numbers take a tenth of the time of floating point,
        # and NumPy is slow where it repeats a colour or an alpha of one value.
        if isinstance(background, tuple):
            behind = cv2.merge([np.full_like(self.alpha, value) for value in background])
        else:
            behind = background
        mixed = np.multiply(self.rgb, alpha, dtype=np.uint16)
        mixed += np.multiply(behind, cv2.bitwise_not(alpha), dtype=np.uint16)
        return cv2.convertScaleAbs(mixed, alpha=1 / 255).astype(np.uint8, copy=False)

    def rgba(self) -> Image:
        """(256, 256, 4) uint8, straight (not premultiplied) alpha."""
        return cv2.merge((self.rgb, self.alpha)).astype(np.uint8, copy=False)
