"""Four channels of every pixel <-> sixteen of every second one.

The frame network works at half the picture's size. Moving a pixel means moving one 32-bit number
here; as float channels in the network it took longer than the convolutions around it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Codes = NDArray[np.uint8]


def unshuffled(image: Codes) -> Codes:
    """(2s, 2s, 4) -> (s, s, 16), ordered by row, column, channel within each block."""
    size = image.shape[0] // 2
    pixels = np.ascontiguousarray(image).view(np.uint32).reshape(size, 2, size, 2)
    blocks = np.ascontiguousarray(pixels.transpose(0, 2, 1, 3))
    return blocks.view(np.uint8).reshape(size, size, 16)


def shuffled(blocks: NDArray[np.generic]) -> NDArray[np.generic]:
    """(s, s, 4) any type, ordered by row and column within each block -> (2s, 2s)."""
    size = blocks.shape[0]
    pixels = blocks.reshape(size, size, 2, 2).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(pixels).reshape(2 * size, 2 * size)
