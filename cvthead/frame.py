"""A rendered frame."""

from __future__ import annotations

from dataclasses import dataclass

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
        alpha = self.alpha[..., None].astype(np.float32) / 255
        behind = np.asarray(background, dtype=np.float32)
        return np.rint(self.rgb * alpha + behind * (1 - alpha)).astype(np.uint8)

    def rgba(self) -> Image:
        """(256, 256, 4) uint8, straight (not premultiplied) alpha."""
        return np.dstack([self.rgb, self.alpha])
