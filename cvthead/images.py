"""Still pictures: safe decoding of untrusted files, and encoding with the AI-generated mark."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.WebPImagePlugin import WebPImageFile

from cvthead.errors import ImageError, ImageTooLargeError, ImageTypeError
from cvthead.png import encode_png
from cvthead.provenance import SourceType, mark_png, xmp_packet

MAX_PIXELS = 50_000_000
MAX_SIDE = 12_000
MIN_SIDE = 32
MAX_BYTES = 100 * 2**20

ImageFormat = Literal["png", "jpeg", "webp"]

_EXIF_ORIENTATION = 0x0112
# EXIF 2.32, tag Orientation: what to apply to the stored picture to see it upright.
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
# What Pillow's readers raise for damaged data; MemoryError comes from absurd chunk lengths.
DAMAGE = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, MemoryError)


def read_image(path: Path | str) -> NDArray[np.uint8]:
    """Read and decode a picture file; see ``decode_image``.

    Raises:
        ImageError: the file cannot be read, or it is no picture that ``decode_image`` accepts.
    """
    try:
        # One byte more than allowed is enough to refuse, whatever the file's size.
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ImageError(
            f"cannot read {path}: {error.strerror}", hint="Check the path and its permissions."
        ) from error
    return decode_image(data)


def decode_image(data: bytes, *, longest: int | None = None) -> NDArray[np.uint8]:
    """Decode a PNG, JPEG or WebP file.

    The type and the size are taken from the header and checked before any pixel is decoded. The
    EXIF orientation is applied, an embedded colour profile is converted to sRGB, transparency is
    composited on white, 16-bit, grey, palette and CMYK pictures become 8-bit RGB, and of an
    animation the first frame is taken.

    Args:
        data: the whole file, at most ``MAX_BYTES``.
        longest: shrink the picture to this longer side. A JPEG is then decoded at a half, a
            quarter or an eighth where that suffices, in a fraction of the time.

    Returns:
        (H, W, 3) uint8 RGB; both sides ``MIN_SIDE`` to ``MAX_SIDE``, at most ``MAX_PIXELS``.

    Raises:
        ImageTypeError: another type; the message names it.
        ImageTooLargeError: too many bytes or pixels.
        ImageError: too small, truncated or damaged.
    """
    if len(data) > MAX_BYTES:
        raise ImageTooLargeError(
            f"the file is larger than {MAX_BYTES >> 20} MiB", hint="Send a smaller picture."
        )
    kind = _sniff(data)
    if kind not in get_args(ImageFormat):
        raise ImageTypeError(
            f"not a PNG, JPEG or WebP picture but {kind}",
            hint="Convert it to JPEG, PNG or WebP first.",
        )
    try:
        # Pillow's WebP reader already allocates the canvas when it opens a file.
        if kind == "webp":
            _check_size(*_webp_size(data))
        if kind == "png":
            with _opened(kind, data) as image:
                _check_size(*image.size)
                image.verify()  # checksums, which decoding alone ignores
        with _opened(kind, data) as image:
            _check_size(*image.size)
            if longest is not None and kind == "jpeg":
                zoom = longest / max(image.size)
                image.draft("RGB", (round(image.width * zoom), round(image.height * zoom)))
            image.load()
            pixels = _rgb(image)
        return pixels if longest is None else shrink(pixels, longest)
    except DAMAGE as error:
        raise ImageError(
            f"the {kind.upper()} file is truncated or damaged ({error})",
            hint="Export or download the picture again.",
        ) from error


def encode_image(
    image: NDArray[np.uint8],
    image_format: ImageFormat = "png",
    *,
    quality: int = 92,
    source: SourceType = SourceType.GENERATED,
) -> bytes:
    """Encode a picture; the result always carries the AI-generated mark.

    Args:
        image: (H, W, 3) RGB or (H, W, 4) RGBA uint8, alpha not premultiplied. JPEG has no alpha
            and gets the picture on white.
        image_format: "png", "jpeg" or "webp".
        quality: 1 to 100 for JPEG and WebP; PNG is lossless.
        source: what the mark says, see ``cvthead.provenance``.

    Raises:
        ImageError: ``image`` has another shape or type, or one that the format cannot hold.
    """
    drawable = image.ndim == 3 and image.shape[2] in (3, 4) and image.size
    if image.dtype != np.uint8 or not drawable:
        raise ImageError(
            f"cannot encode an array of shape {image.shape} and type {image.dtype}",
            hint="Pass (H, W, 3) or (H, W, 4) uint8, H and W at least 1.",
        )
    try:
        if image_format == "png":
            return mark_png(encode_png(image), source)
        out = BytesIO()
        picture = Image.fromarray(on_white(image) if image_format == "jpeg" else image)
        # WebP's default method takes five times as long for a fifth fewer bytes.
        fast = {"method": 0} if image_format == "webp" else {}
        picture.save(out, image_format.upper(), quality=quality, xmp=xmp_packet(source), **fast)
        return out.getvalue()
    except (OSError, ValueError, KeyError) as error:
        raise ImageError(
            f"cannot encode {image.shape[1]} x {image.shape[0]} px as {image_format}: {error}",
            hint="WebP holds up to 16,383 px a side, JPEG up to 65,535 px.",
        ) from error


def on_white(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) of an RGB or RGBA picture, transparency composited on white."""
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:].astype(np.uint16)
    mixed = image[..., :3] * alpha + 255 * (255 - alpha)
    return ((mixed + 127) // 255).astype(np.uint8)


def shrink(image: NDArray[np.uint8], longest: int = 1024) -> NDArray[np.uint8]:
    """The picture, area-averaged so that its longer side is ``longest``; never enlarged."""
    height, width = image.shape[:2]
    zoom = longest / max(height, width)
    if zoom >= 1:
        return image
    size = max(1, round(width * zoom)), max(1, round(height * zoom))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def _sniff(data: bytes) -> str:
    """The type by the first bytes: "png", "jpeg", "webp", or a description of what it is."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if data.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if data.startswith(b"RIFF"):
        return {b"WEBP": "webp", b"AVI ": "an AVI video"}.get(data[8:12], "a RIFF file")
    if data[4:8] == b"ftyp":
        brands = {b"heic": "a HEIC picture", b"heix": "a HEIC picture", b"mif1": "a HEIF picture"}
        brands |= {b"avif": "an AVIF picture", b"avis": "an AVIF picture"}
        return brands.get(data[8:12], "an MP4 or MOV video")
    for start, name in (
        (b"GIF8", "a GIF picture"),
        (b"BM", "a BMP picture"),
        (b"II*\0", "a TIFF picture"),
        (b"MM\0*", "a TIFF picture"),
        (b"8BPS", "a Photoshop file"),
        (b"%PDF", "a PDF document"),
        (b"PK\3\4", "a ZIP archive"),
        (b"\x1a\x45\xdf\xa3", "a Matroska or WebM video"),
        (b"<", "an XML, SVG or HTML document"),
    ):
        if data.startswith(start):
            return name
    return f"an unknown type (first bytes {data[:4].hex(' ')})" if data else "an empty file"


def _opened(kind: str, data: bytes) -> ImageFile:
    # Image.open would warn of, or refuse, a large picture before its size can be reported.
    if kind == "png":
        return PngImageFile(BytesIO(data))
    return JpegImageFile(BytesIO(data)) if kind == "jpeg" else WebPImageFile(BytesIO(data))


def _webp_size(data: bytes) -> tuple[int, int]:
    """Width and height from the header (WebP Container Specification; RFC 9649)."""
    if len(data) < 30 or struct.unpack_from("<I", data, 4)[0] + 8 > len(data):
        raise ValueError("shorter than its header says")
    chunk = data[12:16]
    if chunk == b"VP8X":
        return _little(data[24:27]) + 1, _little(data[27:30]) + 1
    if chunk == b"VP8 ":
        return _little(data[26:28]) & 0x3FFF, _little(data[28:30]) & 0x3FFF
    if chunk == b"VP8L":
        bits = _little(data[21:25])
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    raise ValueError("unknown first chunk")


def _little(data: bytes) -> int:
    return int.from_bytes(data, "little")


def _check_size(width: int, height: int) -> None:
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise ImageTooLargeError(
            f"the picture is too large: {width:,} x {height:,} px",
            hint=f"Shrink it to {MAX_PIXELS // 1_000_000} megapixels or less "
            f"and at most {MAX_SIDE:,} px a side.",
        )
    if min(width, height) < MIN_SIDE:
        raise ImageError(
            f"the picture is too small: {width} x {height} px",
            hint=f"Each side needs {MIN_SIDE} px or more.",
        )


def _rgb(image: Image.Image) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 of a loaded picture of any mode."""
    orientation = _orientation(image)
    profile = image.info.get("icc_profile")
    if image.mode.startswith("I"):  # 16-bit grey, which convert() would clip instead of scale
        image = Image.fromarray((np.asarray(image).clip(0, 65535) >> 8).astype(np.uint8))
    elif image.mode == "CMYK":
        image, profile = _srgb(image, profile), None
    elif image.has_transparency_data:
        image = image.convert("RGBA")
    image = image.convert("RGB") if image.mode not in ("RGB", "RGBA") else image
    image = _srgb(image, profile)
    if orientation in _UPRIGHT:
        image = image.transpose(_UPRIGHT[orientation])
    return on_white(np.array(image))


def _orientation(image: Image.Image) -> int:
    try:
        return int(image.getexif().get(_EXIF_ORIENTATION, 1))
    except (*DAMAGE, TypeError, KeyError, IndexError):
        return 1  # a picture is worth reading without its EXIF data


def _srgb(image: Image.Image, profile: object) -> Image.Image:
    """The picture converted from its colour profile; as it was without a usable one."""
    if not isinstance(profile, bytes):
        return image
    mode = "RGB" if image.mode == "CMYK" else image.mode
    try:
        source = ImageCms.ImageCmsProfile(BytesIO(profile))
        if "sRGB" in ImageCms.getProfileDescription(source):
            return image
        converted = ImageCms.profileToProfile(
            image, source, ImageCms.createProfile("sRGB"), outputMode=mode
        )
    except (ImageCms.PyCMSError, *DAMAGE):
        return image
    return converted or image
