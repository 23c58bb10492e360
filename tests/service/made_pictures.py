"""The sample portrait in every guise that an upload can have."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np
from PIL import Image
from server_process import PORTRAIT

EXIF_ORIENTATION = 0x0112


def portrait(size: int = 512) -> Image.Image:
    with Image.open(PORTRAIT) as image:
        return image.convert("RGB").resize((size, size), Image.Resampling.LANCZOS)


def head(size: int = 300) -> Image.Image:
    """Closer; the largest face of :func:`two_people`."""
    return portrait().crop((80, 0, 380, 300)).resize((size, size))


def saved(image: Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    out = BytesIO()
    image.save(out, kind, **options)
    return out.getvalue()


def two_people() -> bytes:
    """A larger face on the left, a smaller one on the right."""
    both = Image.new("RGB", (540, 300))
    both.paste(head(300), (0, 0))
    both.paste(head(240), (300, 60))
    return saved(both)


def sideways() -> bytes:
    """Stored lying on its side, with the EXIF orientation that puts it upright."""
    exif = Image.Exif()
    exif[EXIF_ORIENTATION] = 6
    turned = portrait().transpose(Image.Transpose.ROTATE_90)
    return saved(turned, "JPEG", quality=95, exif=exif)


def deep_grey() -> bytes:
    """16 bits per pixel."""
    grey = np.asarray(portrait().convert("L"), np.uint16) * 257
    return saved(Image.fromarray(grey))


def with_alpha() -> bytes:
    image = portrait().convert("RGBA")
    image.paste((0, 0, 0, 0), (0, 0, 60, 60))
    return saved(image)


def animated(kind: str) -> bytes:
    """The portrait is the first frame only."""
    blank = Image.new("RGB", (512, 512), "blue")
    return saved(portrait(), kind, save_all=True, append_images=[blank], duration=100)


GUISES: dict[str, Callable[[], bytes]] = {
    "jpeg": lambda: saved(portrait(), "JPEG", quality=95),
    "webp": lambda: saved(portrait(), "WEBP", quality=95),
    "exif": sideways,
    "16-bit": deep_grey,
    "grey": lambda: saved(portrait().convert("L")),
    "cmyk": lambda: saved(portrait().convert("CMYK"), "JPEG", quality=95),
    "palette": lambda: saved(portrait().quantize(256)),
    "alpha": with_alpha,
    "animated png": lambda: animated("PNG"),
    "animated webp": lambda: animated("WEBP"),
}


def png_header(width: int, height: int) -> bytes:
    """A small PNG file that says it is of this size."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes(1_000_000))
    chunks = ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


def jpeg_header(width: int, height: int) -> bytes:
    data = saved(Image.new("RGB", (64, 64)), "JPEG")
    place = data.index(b"\xff\xc0") + 5
    return data[:place] + struct.pack(">HH", height, width) + data[place + 4 :]


def webp_header(width: int, height: int) -> bytes:
    size = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    chunk = b"VP8X" + struct.pack("<I", 10) + bytes(4) + size
    return b"RIFF" + struct.pack("<I", 4 + len(chunk)) + b"WEBP" + chunk


def opened(data: bytes) -> Image.Image:
    return Image.open(BytesIO(data))


def pixels(data: bytes, mode: str = "RGBA") -> np.ndarray:
    return np.asarray(opened(data).convert(mode), np.int16)


def difference(a: np.ndarray, b: np.ndarray) -> float:
    """Mean of two RGBA pictures over the pixels that either shows."""
    shown = (a[..., 3] > 0) | (b[..., 3] > 0)
    return float(np.abs(a - b)[shown].mean())
