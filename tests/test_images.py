from __future__ import annotations

import re
import struct
import subprocess
import sys
import zlib
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageCms
from PIL.PngImagePlugin import PngImageFile

from cvthead.errors import ImageError
from cvthead.images import decode_image, encode_image, on_white, read_image, shrink

EXIF_ORIENTATION = 0x0112


def picture(height: int = 60, width: int = 80) -> NDArray[np.uint8]:
    """Smooth, with four different corners."""
    y, x = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    return np.stack([255 * x, 255 * y, 255 * (1 - x)], axis=-1).astype(np.uint8)


def saved(image: Image.Image, kind: str, **options: object) -> bytes:
    out = BytesIO()
    image.save(out, kind, **options)
    return out.getvalue()


def chunk(kind: bytes, body: bytes) -> bytes:
    crc = struct.pack(">I", zlib.crc32(kind + body))
    return struct.pack(">I", len(body)) + kind + body + crc


def png_header(width: int, height: int) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    pixels = chunk(b"IDAT", zlib.compress(bytes(1000)))
    return b"\x89PNG\r\n\x1a\n" + header + pixels + chunk(b"IEND", b"")


def jpeg_header(width: int, height: int) -> bytes:
    data = saved(Image.new("RGB", (64, 64)), "JPEG")
    return re.sub(
        rb"(\xff\xc0\x00\x11\x08)....", rb"\1" + struct.pack(">HH", height, width), data, count=1
    )


def webp_header(width: int, height: int, kind: bytes) -> bytes:
    if kind == b"VP8X":
        body = bytes(4) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    elif kind == b"VP8L":
        body = b"\x2f" + (width - 1 | (height - 1) << 14).to_bytes(4, "little") + bytes(30)
    else:
        body = b"\x50\x02\x00\x9d\x01\x2a" + struct.pack("<HH", width, height) + bytes(30)
    body = b"WEBP" + kind + struct.pack("<I", len(body)) + body + bytes(len(body) % 2)
    body += b"VP8 " + struct.pack("<I", 40) + bytes(40)
    return b"RIFF" + struct.pack("<I", len(body)) + body


BOMBS = {
    "png_20000": png_header(20_000, 20_000),
    "png_30000": png_header(30_000, 30_000),
    "png_limit": png_header(2**31 - 1, 2**31 - 1),
    "jpeg_20000": jpeg_header(20_000, 20_000),
    "jpeg_65500": jpeg_header(65_500, 65_500),
    "webp_vp8x": webp_header(30_000, 30_000, b"VP8X"),
    "webp_vp8l": webp_header(16_000, 16_000, b"VP8L"),
    "webp_vp8": webp_header(16_000, 16_000, b"VP8 "),
    "narrow": png_header(12_001, 32),
    "area": png_header(11_000, 11_000),
}


@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.filterwarnings("error")
def test_a_large_header_is_refused_by_its_size(name: str) -> None:
    with pytest.raises(ImageError, match=r"too large: [\d,]+ x [\d,]+ px") as caught:
        decode_image(BOMBS[name])
    assert "megapixels" in caught.value.hint


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads Linux's /proc")
def test_large_headers_allocate_no_memory(tmp_path: Path) -> None:
    for name, data in BOMBS.items():
        (tmp_path / name).write_bytes(data)
    # In a process of its own, as the peak of this one may already be higher.
    script = """
import re, sys
from pathlib import Path
from cvthead.errors import ImageError
from cvthead.images import decode_image, encode_image
import numpy as np
def peak():
    return int(re.search(r"VmPeak:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
for kind in ("png", "jpeg", "webp"):
    decode_image(encode_image(np.zeros((64, 64, 3), np.uint8), kind))
before = peak()
for file in Path(sys.argv[1]).iterdir():
    try:
        decode_image(file.read_bytes())
    except ImageError:
        pass
print(peak() - before)
"""
    run = [sys.executable, "-c", script, str(tmp_path)]
    repository = Path(__file__).parents[1]
    result = subprocess.run(run, capture_output=True, text=True, cwd=repository, check=True)
    assert int(result.stdout) < 20_000  # kB; the smallest bomb would take 360,000


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"", "an empty file"),
        (b"hello, this is text", "unknown type"),
        (b"%PDF-1.7", "PDF"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "SVG"),
        (b"\0\0\0\x18ftypheic", "HEIC"),
        (b"\0\0\0\x18ftypisom", "MP4"),
        (saved(Image.new("RGB", (64, 64)), "GIF"), "GIF"),
        (saved(Image.new("RGB", (64, 64)), "BMP"), "BMP"),
        (saved(Image.new("RGB", (64, 64)), "TIFF"), "TIFF"),
    ],
)
def test_other_types_are_refused_by_name(data: bytes, found: str) -> None:
    with pytest.raises(ImageError, match=f"not a PNG, JPEG or WebP picture but .*{found}"):
        decode_image(data)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP"])
@pytest.mark.parametrize("size", [(1, 1), (31, 200), (200, 31)])
def test_small_pictures_are_refused(kind: str, size: tuple[int, int]) -> None:
    with pytest.raises(ImageError, match=f"too small: {size[0]} x {size[1]} px"):
        decode_image(saved(Image.new("RGB", size), kind))


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP"])
def test_every_truncation_is_refused(kind: str) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    data = saved(Image.fromarray(noise), kind)
    assert decode_image(data).shape == (64, 64, 3)
    for length in (*range(4, 100), *range(100, len(data) - 100, 97), len(data) - 20):
        with pytest.raises(ImageError):
            decode_image(data[:length])


# Pillow warns of broken EXIF data and goes on.
@pytest.mark.filterwarnings("ignore:Corrupt EXIF data:UserWarning")
@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP"])
def test_damage_raises_nothing_but_image_error(kind: str) -> None:
    rng = np.random.default_rng(1)
    whole = np.frombuffer(saved(Image.fromarray(picture()), kind, exif=Image.Exif()), np.uint8)
    for _ in range(300):
        data = whole.copy()
        data[rng.integers(12, len(data), 4)] = rng.integers(0, 256, 4)
        with suppress(ImageError):
            assert decode_image(data.tobytes()).shape[2] == 3


def test_a_changed_pixel_byte_of_a_png_is_noticed() -> None:
    data = bytearray(saved(Image.fromarray(picture()), "PNG"))
    data[data.index(b"IDAT") + 40] ^= 1
    with pytest.raises(ImageError, match="damaged"):
        decode_image(bytes(data))


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied(kind: str, orientation: int) -> None:
    upright = picture()
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright),  # a camera held so that the picture needs a clockwise turn
        7: np.rot90(upright, 2).transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[orientation]
    exif = Image.Exif()
    exif[EXIF_ORIENTATION] = orientation
    image = Image.fromarray(np.ascontiguousarray(stored))
    decoded = decode_image(saved(image, kind, exif=exif))
    assert decoded.shape == upright.shape
    assert np.abs(decoded.astype(int) - upright).mean() < 6


# Pillow warns of broken EXIF data and goes on.
@pytest.mark.filterwarnings("ignore:Corrupt EXIF data:UserWarning")
def test_broken_exif_does_not_hide_the_picture() -> None:
    data = saved(Image.fromarray(picture()), "PNG", exif=b"Exif\0\0MM\0*\0\0\xff\xff broken")
    assert np.array_equal(decode_image(data), picture())


def test_16_bit_grey_is_scaled() -> None:
    deep = np.linspace(0, 65535, 64 * 64).astype(np.uint16).reshape(64, 64)
    decoded = decode_image(saved(Image.fromarray(deep), "PNG"))
    assert decoded.dtype == np.uint8
    assert np.array_equal(decoded, np.repeat((deep >> 8).astype(np.uint8)[..., None], 3, -1))


def test_16_bit_rgb_is_scaled() -> None:
    cv2 = pytest.importorskip("cv2")
    deep = picture().astype(np.uint16) * 257
    data = cv2.imencode(".png", deep[..., ::-1])[1].tobytes()
    assert np.array_equal(decode_image(data), picture())


@pytest.mark.parametrize("mode", ["1", "L", "P"])
@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_grey_and_palette(mode: str, kind: str) -> None:
    image = Image.fromarray(picture()).convert(mode)
    expected = np.asarray(image.convert("RGB"))
    assert np.array_equal(decode_image(saved(image, kind, lossless=True)), expected)


def test_grey_jpeg_has_three_equal_channels() -> None:
    decoded = decode_image(saved(Image.fromarray(picture()).convert("L"), "JPEG"))
    assert decoded.shape == (60, 80, 3)
    assert np.array_equal(decoded[..., 0], decoded[..., 2])


def test_alpha_is_composited_on_white() -> None:
    rgba = np.dstack([picture(), np.full((60, 80), 255, np.uint8)])
    rgba[:, :20, 3] = 0
    rgba[:, 20:40, 3] = 51  # a fifth
    decoded = decode_image(saved(Image.fromarray(rgba), "PNG")).astype(int)
    assert (decoded[:, :20] == 255).all()
    assert np.array_equal(decoded[:, 40:], picture()[:, 40:])
    fifth = 255 * 0.8 + picture()[:, 20:40] * 0.2
    assert np.abs(decoded[:, 20:40] - fifth).max() <= 0.5


@pytest.mark.parametrize("mode", ["P", "L", "RGB", "LA"])
def test_transparency_without_alpha_channel(mode: str) -> None:
    image = Image.new("RGB", (64, 64), (0, 0, 0)).convert(mode)
    if mode == "LA":
        image.putalpha(0)
        data = saved(image, "PNG")
    else:
        data = saved(image, "PNG", transparency=(0, 0, 0) if mode == "RGB" else 0)
    assert (decode_image(data) == 255).all()


def test_jpeg_decoded_at_a_fraction_is_the_shrunk_picture() -> None:
    line = np.linspace(0, 255, 1600)
    picture = np.dstack([np.broadcast_to(line, (1200, 1600))] * 3).astype(np.uint8)
    data = encode_image(picture, "jpeg")
    for longest, shape in ((800, (600, 800, 3)), (500, (375, 500, 3)), (4000, picture.shape)):
        small = decode_image(data, longest=longest)
        assert small.shape == shape
        expected = cv2.resize(picture, shape[1::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(small.astype(int) - expected).max() <= 6
    png = decode_image(encode_image(picture), longest=800)
    assert png.shape == (600, 800, 3)


def test_cmyk_jpeg() -> None:
    image = Image.fromarray(picture()).convert("CMYK")
    decoded = decode_image(saved(image, "JPEG", quality=95))
    assert np.abs(decoded.astype(int) - picture()).mean() < 6


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_the_first_frame_of_an_animation_is_taken(kind: str) -> None:
    frames = [Image.new("RGB", (64, 48), colour) for colour in ("red", "lime", "blue")]
    options = {"save_all": True, "append_images": frames[1:], "duration": 100}
    decoded = decode_image(saved(frames[0], kind, **options))
    assert decoded.shape == (48, 64, 3)
    assert np.abs(decoded.astype(int) - (255, 0, 0)).max() < 8


def test_a_colour_profile_is_converted() -> None:
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    renamed = srgb.replace(b"\0s\0R\0G\0B", b"\0o\0d\0d\0 ")
    # Red and blue primaries exchanged, so that a picture in it has exchanged channels.
    swapped = renamed.replace(b"rXYZ", b"....").replace(b"bXYZ", b"rXYZ").replace(b"....", b"bXYZ")
    assert renamed != srgb
    assert swapped != renamed
    image = Image.fromarray(picture())
    assert np.array_equal(decode_image(saved(image, "PNG", icc_profile=srgb)), picture())
    for kind in ("PNG", "WEBP"):
        decoded = decode_image(saved(image, kind, icc_profile=swapped, lossless=True))
        assert np.abs(decoded.astype(int) - picture()[..., ::-1]).max() <= 1
    damaged = saved(image, "PNG", icc_profile=b"no profile")
    assert np.array_equal(decode_image(damaged), picture())


def test_read_image(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    file.write_bytes(saved(Image.fromarray(picture()), "PNG"))
    assert np.array_equal(read_image(file), picture())
    for wrong in (tmp_path, tmp_path / "absent.png"):
        with pytest.raises(ImageError, match="cannot read"):
            read_image(wrong)


@pytest.mark.parametrize("kind", ["png", "jpeg", "webp"])
@pytest.mark.parametrize("channels", [3, 4])
def test_what_is_encoded_can_be_decoded(kind: str, channels: int) -> None:
    image = np.dstack([picture(), np.full((60, 80), 128, np.uint8)])[..., :channels]
    decoded = decode_image(encode_image(image, kind))  # type: ignore[arg-type]
    assert np.abs(decoded.astype(int) - on_white(image)).mean() < (0.51 if kind == "png" else 4)


def test_alpha_survives_in_png_and_webp() -> None:
    image = np.dstack([picture(), picture()[..., 0]])
    for kind in ("png", "webp"):
        with Image.open(BytesIO(encode_image(image, kind))) as opened:
            assert np.array_equal(np.asarray(opened)[..., 3], image[..., 3])


@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 5, 3), (64, 48, 4), (300, 1, 4)])
def test_png_is_lossless(shape: tuple[int, int, int]) -> None:
    noise = np.random.default_rng(3).integers(0, 256, shape, np.uint8)
    for image in (noise, np.full(shape, 200, np.uint8), noise[::-1, ::-1]):
        with PngImageFile(BytesIO(encode_image(image))) as opened:
            opened.verify()  # checksums
        with Image.open(BytesIO(encode_image(image))) as opened:
            assert np.array_equal(np.asarray(opened), image)


def test_encode_image_refuses_what_it_cannot_encode() -> None:
    wrong_shape, no_pixels = np.zeros((8, 8), np.uint8), np.zeros((0, 8, 3), np.uint8)
    for wrong in (wrong_shape, no_pixels, np.zeros((8, 8, 3), np.float32)):
        with pytest.raises(ImageError, match="cannot encode an array"):
            encode_image(wrong)  # type: ignore[arg-type]
    with pytest.raises(ImageError, match="as webp"):
        encode_image(np.zeros((1, 20_000, 3), np.uint8), "webp")


def test_shrink() -> None:
    assert shrink(picture(600, 800), 400).shape == (300, 400, 3)
    assert shrink(picture(4000, 8), 400).shape == (400, 1, 3)
    assert np.array_equal(shrink(picture(), 400), picture())
    assert abs(shrink(picture(600, 800), 100).mean() - picture(600, 800).mean()) < 1
