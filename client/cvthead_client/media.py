"""Cameras, video files and pictures for ``cvthead-call``; needs the extra ``video``."""

from __future__ import annotations

import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import NamedTuple
from uuid import UUID
from xml.sax.saxutils import escape

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from numpy.typing import NDArray
from PIL import Image

from cvthead_client.errors import CVTHeadClientError

Rgb = NDArray[np.uint8]
# Containers that hold their own data: a playlist could make the reader open other files.
CONTAINERS = "mov,mp4,matroska,webm,avi,mpegts,mpeg,flv,asf,gif,apng"
# Enough for the face networks of the service; more only fills the line.
LONGEST_SIDE = 640
JPEG_QUALITY = 85
CLOCK = Fraction(1, 90_000)
# XMP Specification Part 3, section 1.1.3: the box that holds XMP in MP4.
XMP_BOX = UUID("be7acfcb-97a9-42e8-9c71-999491e3afac").bytes


class Captured(NamedTuple):
    """``rgb``: (H, W, 3) uint8. ``time``: seconds since the first frame."""

    rgb: Rgb
    time: float


def read_video(path: Path) -> Iterator[Captured]:
    """Frames of a video file, upright.

    Raises:
        CVTHeadClientError: no readable video.
    """
    options = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
    with _errors(str(path)):
        # Absolute, so that a file name with a colon is not taken for a protocol.
        container = av.open(
            str(path.absolute()), container_options=options, metadata_errors="replace"
        )
    with container:
        yield from _frames(container, str(path), live=False)


def read_camera(name: str) -> Iterator[Captured]:
    """Frames of a camera, for ever.

    Args:
        name: a number from 0, or the device's name as the operating system knows it.

    Raises:
        CVTHeadClientError: no such camera, or it is in use.
    """
    if sys.platform == "darwin":
        device, kind = name, "avfoundation"
    elif sys.platform == "win32":
        device, kind = f"video={name}", "dshow"
    else:
        device, kind = (f"/dev/video{name}" if name.isdecimal() else name), "v4l2"
    with _errors(f"camera {name}"):
        container = av.open(device, format=kind, options={"framerate": "30"})
    with container:
        yield from _frames(container, f"camera {name}", live=True)


def _frames(container: InputContainer, name: str, *, live: bool) -> Iterator[Captured]:
    with _errors(name):
        if not container.streams.video:
            raise CVTHeadClientError(f"{name} has no pictures", hint="choose another video")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate or stream.guessed_rate or 25)
        begin: float | None = None
        count = 0
        for frame in container.decode(stream):
            stamp = count / rate if frame.time is None else frame.time
            if live:
                stamp = time.monotonic()  # cameras' own clocks are of many kinds
            begin = stamp if begin is None else begin
            count += 1
            yield Captured(_upright(frame), stamp - begin)
        if not count:
            raise CVTHeadClientError(f"{name} holds no frame", hint="choose another video")


def _upright(frame: VideoFrame) -> Rgb:
    turned = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90))
    return np.ascontiguousarray(turned, dtype=np.uint8)


@contextmanager
def _errors(name: str) -> Iterator[None]:
    try:
        yield
    except (av.FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CVTHeadClientError(
            f"cannot read {name}: {reason}", hint="use a complete video file, or a camera's number"
        ) from error


def jpeg_of(rgb: Rgb) -> bytes:
    """A driving frame for the service: JPEG, not larger than LONGEST_SIDE."""
    picture = Image.fromarray(rgb)
    picture.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
    out = BytesIO()
    picture.save(out, "JPEG", quality=JPEG_QUALITY)
    return out.getvalue()


def rgb_of(data: bytes) -> Rgb:
    """(H, W, 3) of a rendered frame's file, transparency on white."""
    with Image.open(BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as picture:
        if picture.mode == "RGBA":
            white = Image.new("RGBA", picture.size, "white")
            return np.array(Image.alpha_composite(white, picture).convert("RGB"))
        return np.array(picture.convert("RGB"))


@contextmanager
def mp4_writer(path: Path, size: int, source_type: str) -> Iterator[Callable[[Rgb, float], None]]:
    """Write an H.264 file with the mark for AI-generated media; it appears when it is complete.

    Args:
        size: side of the frames in pixels; an odd one gains a pixel.
        source_type: IPTC DigitalSourceType, a URI.

    Yields:
        The function that appends (image, seconds). A time that is not later than the frame's
        before leaves the frame out.

    Raises:
        CVTHeadClientError: the file cannot be written, or there was no frame.
    """
    temporary = path.with_name(f".{path.name}.part")
    try:
        with av.open(
            str(temporary.absolute()), "w", format="mp4", options={"movflags": "+faststart"}
        ) as container:
            container.metadata["comment"] = f"AI-generated: {source_type}"
            stream = container.add_stream(
                "libx264", rate=30, options={"preset": "veryfast", "crf": "18"}
            )
            stream.width = stream.height = size + size % 2
            stream.pix_fmt = "yuv420p"
            stream.codec_context.time_base = CLOCK
            latest = -1

            def write(image: Rgb, seconds: float) -> None:
                nonlocal latest
                stamp = round(seconds / CLOCK)
                if stamp <= latest:
                    return
                padded = np.pad(image, ((0, size % 2), (0, size % 2), (0, 0)), mode="edge")
                frame = VideoFrame.from_ndarray(padded, format="rgb24")
                frame.pts, frame.time_base, latest = stamp, CLOCK, stamp
                container.mux(stream.encode(frame))

            yield write
            if latest < 0:
                raise CVTHeadClientError(
                    "no frame came back", hint="is a face visible from the front?"
                )
            container.mux(stream.encode(None))
        with temporary.open("ab") as file:
            file.write(_mark(source_type))
        temporary.replace(path)
    except (av.FFmpegError, OSError) as error:
        raise CVTHeadClientError(
            f"cannot write {path}: {error.strerror or error}", hint="choose another --output"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _mark(source_type: str) -> bytes:
    """The XMP box with the IPTC property DigitalSourceType, to append to an MP4 file."""
    packet = (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about=""'
        ' xmlns:Iptc4xmpExt="http://iptc.org/std/Iptc4xmpExt/2008-02-29/">'
        f"<Iptc4xmpExt:DigitalSourceType>{escape(source_type)}</Iptc4xmpExt:DigitalSourceType>"
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
        '<?xpacket end="r"?>'
    ).encode()
    return struct.pack(">I", len(packet) + 24) + b"uuid" + XMP_BOX + packet
