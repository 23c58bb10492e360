"""Safe reading of videos, such as the driver of an animation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from cvthead.errors import VideoError
from cvthead.images import MAX_PIXELS, MAX_SIDE

# Containers that hold their own data: a playlist (HLS, DASH, concat) could make the reader open
# other files of the machine.
_CONTAINERS = "mov,mp4,matroska,webm,avi,mpegts,mpeg,flv,asf,gif,apng"
_DECODER = {"max_pixels": str(MAX_PIXELS)}


@dataclass(frozen=True)
class VideoInfo:
    """What a video file's header says.

    Attributes:
        width, height: pixels of the upright picture.
        fps: average frames per second.
        frames: number of frames, an estimate where the container does not store it; 0 unknown.
        duration: seconds; 0 unknown.
        has_audio: whether there is a sound track.
    """

    width: int
    height: int
    fps: float
    frames: int
    duration: float
    has_audio: bool


class TimedFrame(NamedTuple):
    """``rgb``: (H, W, 3) uint8, upright. ``time``: seconds since the start of the file."""

    rgb: NDArray[np.uint8]
    time: float


def probe_video(path: Path | str) -> VideoInfo:
    """Read a video's properties; its first frame is decoded.

    Raises:
        VideoError: no such file, not a video, without a video track, too large, or damaged.
    """
    height, width = next(read_frames(path)).rgb.shape[:2]
    with open_input(path) as container:
        stream = _video_stream(path, container)
        fps = _fps(stream)
        if stream.duration is not None and stream.time_base is not None:
            duration = float(stream.duration * stream.time_base)
        else:
            duration = (container.duration or 0) / av.time_base
        frames = stream.frames or round(duration * fps)
        return VideoInfo(width, height, fps, frames, duration, bool(container.streams.audio))


def read_frames(path: Path | str) -> Iterator[TimedFrame]:
    """Decode a video frame by frame, upright and with square pixels.

    Raises:
        VideoError: as ``probe_video``; damage in the middle is reported when it is reached.
    """
    count = 0
    with open_input(path) as container:
        stream = _video_stream(path, container)
        start = (container.start_time or 0) / av.time_base
        for packet in container.demux(stream):
            if packet.is_corrupt:
                raise _unreadable(path, "it is cut off")
            for frame in packet.decode():
                time = count / _fps(stream) if frame.time is None else frame.time - start
                count += 1
                yield TimedFrame(_upright(frame, stream.sample_aspect_ratio), time)
    if not count:
        raise _unreadable(path, "it holds no frame")


@contextmanager
def open_input(path: Path | str) -> Iterator[InputContainer]:
    """Open a media file for PyAV; only containers that hold their own data are accepted.

    Raises:
        VideoError: no such file, not such a container, or any error of PyAV in the block.
    """
    if not Path(path).is_file():
        raise VideoError(f"there is no file {path}", hint="Check the path.")
    # Absolute, so that a file name with a colon is not taken for a protocol.
    location = str(Path(path).absolute())
    try:
        with av.open(
            location,
            container_options={"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"},
            options=_DECODER,  # opening already decodes a frame where the header says too little
            metadata_errors="replace",  # damaged tags are no reason to refuse the pictures
        ) as container:
            yield container
    except (av.FFmpegError, OSError) as error:
        raise _unreadable(path, error.strerror or str(error)) from error


def _unreadable(path: Path | str, reason: str) -> VideoError:
    return VideoError(
        f"{path} is not a readable video: {reason}",
        hint="Use a complete MP4, MOV, WebM, MKV or AVI file of 1080p or less.",
    )


def _video_stream(path: Path | str, container: InputContainer) -> VideoStream:
    for stream in container.streams.video:
        if stream.disposition & Disposition.attached_pic:  # the cover of a music file
            continue
        if stream.codec_context is None:
            raise _unreadable(path, "its codec is unknown")
        width, height = stream.width, stream.height
        if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
            raise VideoError(
                f"the video is too large: {width:,} x {height:,} px",
                hint="Shrink it to 1080p or less.",
            )
        # The header is not binding; the decoder itself refuses larger frames.
        stream.codec_context.options = _DECODER
        stream.thread_type = "AUTO"
        return stream
    raise _unreadable(path, "it has no video track")


def _fps(stream: VideoStream) -> float:
    return float(stream.average_rate or stream.guessed_rate or 25)


def _upright(frame: VideoFrame, aspect: Fraction | None) -> NDArray[np.uint8]:
    """(H, W, 3) RGB with square pixels, turned as the file's display matrix says."""
    width = round(frame.width * aspect) if aspect else frame.width
    rgb = frame.to_ndarray(format="rgb24", width=min(width, MAX_SIDE))
    turned = np.rot90(rgb, round(frame.rotation / 90))
    return np.ascontiguousarray(turned, dtype=np.uint8)
