"""Damaged and hostile images: what a decoder meets on an open port."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable

import numpy as np
from PIL import Image

Mutation = Callable[[bytes, np.random.Generator], bytes]
MAX_SIDE = 320


def seeds(portrait: Image.Image) -> list[bytes]:
    """The portrait in every format and colour mode that a client may send."""
    small = portrait.convert("RGB").crop((60, 0, 460, 400)).resize((MAX_SIDE, MAX_SIDE))
    exif = Image.Exif()
    exif[0x0112] = 6  # orientation: turned by 90 degrees
    turned = small.rotate(90)
    return [
        _file(small, "PNG"),
        _file(small.convert("RGBA"), "PNG"),
        _file(small.convert("L"), "PNG"),
        _file(small.convert("P"), "PNG"),
        _file(small.convert("I;16"), "PNG"),
        _file(small, "JPEG", quality=85),
        _file(small, "JPEG", progressive=True),
        _file(small.convert("CMYK"), "JPEG"),
        _file(turned, "JPEG", exif=exif),
        _file(small, "WEBP"),
        _file(small, "WEBP", lossless=True),
        _file(small, "WEBP", save_all=True, append_images=[turned], duration=40),
    ]


def mutated(data: bytes, random: np.random.Generator) -> bytes:
    """One to three random mutations."""
    for _ in range(random.integers(1, 4)):
        data = MUTATIONS[random.integers(len(MUTATIONS))](data, random)
    return data


def _file(image: Image.Image, kind: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def _flip_bits(data: bytes, random: np.random.Generator) -> bytes:
    values = bytearray(data)
    for place in random.integers(0, max(1, len(values)), 8):
        if values:
            values[place] ^= 1 << int(random.integers(8))
    return bytes(values)


def _damage_head(data: bytes, random: np.random.Generator) -> bytes:
    values = bytearray(data)
    for place in random.integers(0, max(1, min(64, len(values))), 3):
        if values:
            values[place] = int(random.integers(256))
    return bytes(values)


def _truncate(data: bytes, random: np.random.Generator) -> bytes:
    return data[: int(random.integers(0, len(data) + 1))]


def _cut_out(data: bytes, random: np.random.Generator) -> bytes:
    begin, end = sorted(int(place) for place in random.integers(0, len(data) + 1, 2))
    return data[:begin] + data[end:]


def _repeat(data: bytes, random: np.random.Generator) -> bytes:
    begin, end = sorted(int(place) for place in random.integers(0, len(data) + 1, 2))
    return data[:end] + data[begin:]


def _insert_noise(data: bytes, random: np.random.Generator) -> bytes:
    place = int(random.integers(0, len(data) + 1))
    return data[:place] + random.bytes(int(random.integers(1, 2000))) + data[place:]


def _grow_png(data: bytes, random: np.random.Generator) -> bytes:
    """Other dimensions in a PNG's header, with a correct checksum: a bomb."""
    if data[12:16] != b"IHDR" or len(data) < 33:
        return data
    side = int(random.choice([0, 1, 30_000, 2**31 - 1, 2**32 - 1]))
    head = b"IHDR" + struct.pack(">II", side, side) + data[24:29]
    return data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]


def _grow_jpeg(data: bytes, random: np.random.Generator) -> bytes:
    """Other dimensions in a JPEG's frame header."""
    for marker in (b"\xff\xc0", b"\xff\xc2"):
        place = data.find(marker)
        if place > 0:
            size = struct.pack(">HH", *random.choice([0, 1, 9_000, 65_535], 2))
            return data[: place + 5] + size + data[place + 9 :]
    return data


MUTATIONS: tuple[Mutation, ...] = (
    _flip_bits,
    _damage_head,
    _truncate,
    _cut_out,
    _repeat,
    _insert_noise,
    _grow_png,
    _grow_jpeg,
)
