"""A PNG encoder for rendered heads, many times faster than the general ones."""

from __future__ import annotations

import struct

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPES = {3: 2, 4: 6}  # channels: truecolour, truecolour with alpha
_BIT_DEPTH = 8
_UP = 2
# ISA-L's level 1 is the fastest one that matches repetitions well; higher ones gain under 1 %.
_LEVEL = 1


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """A PNG file (W3C PNG, third edition) of a picture.

    Every row is stored as its difference to the row above (filter type 2, Up), which NumPy takes
    in one step, and compressed by Intel's ISA-L. For rendered heads the file is within a few
    percent of what OpenCV's encoder makes, which needs more than four times as long.

    Args:
        image: (H, W, 3) RGB or (H, W, 4) RGBA uint8, H and W at least 1.
    """
    height, width, channels = image.shape
    samples = image.reshape(height, width * channels)
    rows = np.empty((height, 1 + width * channels), np.uint8)
    rows[:, 0] = _UP
    rows[0, 1:] = samples[0]  # above the first row there are zeros
    np.subtract(samples[1:], samples[:-1], out=rows[1:, 1:])
    kind = _COLOUR_TYPES[channels]
    # The zeros: the only compression and filter methods there are, not interlaced.
    header = struct.pack(">IIBBBBB", width, height, _BIT_DEPTH, kind, 0, 0, 0)
    return b"".join(
        (
            _SIGNATURE,
            _chunk(b"IHDR", header),
            _chunk(b"IDAT", isal_zlib.compress(rows, _LEVEL)),
            _chunk(b"IEND", b""),
        )
    )


def _chunk(name: bytes, data: bytes) -> bytes:
    checksum = isal_zlib.crc32(data, isal_zlib.crc32(name))
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", checksum)
