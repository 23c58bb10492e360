"""Four channels of every pixel <-> sixteen of every second one.

The frame network works at half the picture's size. Moving two neighbours means moving one 64-bit
number here; as float channels in the network it took longer than the convolutions around it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Codes = NDArray[np.uint8]


def unshuffled(image: Codes) -> Codes:
    """(2s, 2s, 4) -> (s, s, 16), ordered by row, column, channel within each block."""
    size = image.shape[0] // 2
    pairs = np.ascontiguousarray(image).reshape(size, 2, 8 * size).view(np.uint64)
    blocks = np.ascontiguousarray(pairs.transpose(0, 2, 1))
    return blocks.view(np.uint8).reshape(size, size, 16)


def shuffled(blocks: NDArray[np.unsignedinteger]) -> NDArray[np.unsignedinteger]:
    """(s, s, 4) of up to 32 bits, ordered by row and column within each block -> (2s, 2s)."""
    size, kind = blocks.shape[0], blocks.dtype
    pairs = blocks.view(f"u{2 * kind.itemsize}")  # (s, s, 2)
    rows = np.ascontiguousarray(pairs.transpose(0, 2, 1))
    return rows.view(kind).reshape(2 * size, 2 * size)
