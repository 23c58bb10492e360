"""Writing videos as MP4, GIF, animated PNG or a folder of PNG files.

Every output appears whole or not at all, and carries the AI-generated mark.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Protocol

import av
import numpy as np
from numpy.typing import NDArray

from cvthead.errors import VideoError
from cvthead.files import atomic_path, write_errors
from cvthead.provenance import SourceType
from cvthead.video_formats import apng, folder, gif, mp4


class WriteFrame(Protocol):
    """Appends a frame.

    ``image``: (H, W, 3) RGB or (H, W, 4) RGBA uint8, alpha not premultiplied. ``time``: when it
    is shown, in seconds, larger than the frame's before; without it frames follow at the
    nominal rate.
    """

    def __call__(self, image: NDArray[np.uint8], time: float | None = None) -> None: ...


@contextmanager
def video_writer(
    path: Path | str,
    *,
    size: tuple[int, int],
    fps: float,
    audio_from: Path | str | None = None,
    source: SourceType = SourceType.GENERATED,
) -> Iterator[WriteFrame]:
    """Write a video; the ending of ``path`` chooses the format.

    - ``.mp4``: H.264, yuv420p, BT.709, index first; an odd side gains a pixel. On white.
    - ``.gif``: 256 colours chosen over the whole video, endless loop, at most 50 frames per
      second (frames between are dropped, as browsers play faster files slowly). On white.
    - ``.png``, ``.apng``: animated PNG, lossless, with alpha, endless loop.
    - no ending: a new folder of ``000000.png``, ``000001.png``, ..., with alpha.

    Args:
        path: the output; it exists only once the block has ended without an error.
        size: (width, height) of every frame in pixels.
        fps: nominal frames per second, above 0.
        audio_from: a video whose sound is put below an MP4, up to the last frame's end: AAC is
            copied, other codecs are converted to AAC. Ignored for the other formats.
        source: what the AI-generated mark says.

    Yields:
        The function that appends a frame.

    Raises:
        VideoError: unknown ending, wrong size or time of a frame, no frame, unreadable
            ``audio_from``.
        InputError: the output cannot be written, see ``cvthead.files.atomic_path``.
    """
    target = Path(path)
    rate = Fraction(fps).limit_denominator(1001)
    if rate <= 0 or min(size) < 1:
        raise VideoError(
            f"cannot write {size[0]} x {size[1]} px at {fps} frames per second",
            hint="Size and frame rate must be above 0.",
        )
    ending = target.suffix.lower()
    if ending not in ("", ".mp4", ".gif", ".png", ".apng"):
        raise VideoError(
            f"unknown video ending {target.suffix}",
            hint="Use .mp4, .gif, .png (animated), or no ending for a folder of PNG files.",
        )
    with atomic_path(target, folder=not ending) as temporary:
        match ending:
            case "":
                encoder = folder(temporary, source)
            case ".mp4":
                encoder = mp4(temporary, size, rate, audio_from, source)
            case ".gif":
                encoder = gif(temporary, size, rate, source)
            case _:
                encoder = apng(temporary, size, rate, source)
        with closing(encoder):
            with _encoding_errors(target):
                next(encoder)
            latest: float | None = None

            def write(image: NDArray[np.uint8], time: float | None = None) -> None:
                nonlocal latest
                if time is None:
                    time = 0.0 if latest is None else latest + float(1 / rate)
                _check_frame(image, size, time, latest)
                with _encoding_errors(target):
                    encoder.send((image, time))
                latest = time

            yield write
            if latest is None:
                raise VideoError("the video has no frame", hint="Write one frame or more.")
            with _encoding_errors(target), suppress(StopIteration):
                encoder.send(None)


@contextmanager
def _encoding_errors(target: Path) -> Iterator[None]:
    try:
        with write_errors(target):
            yield
    except av.FFmpegError as error:
        raise VideoError(
            f"cannot encode {target}: {error.strerror or error}",
            hint="Use another size, frame rate or format.",
        ) from error


def _check_frame(
    image: NDArray[np.uint8], size: tuple[int, int], time: float, latest: float | None
) -> None:
    expected = size[1], size[0]
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise VideoError(
            f"a frame has shape {image.shape} and type {image.dtype}",
            hint="Pass (H, W, 3) or (H, W, 4) uint8.",
        )
    if image.shape[:2] != expected:
        raise VideoError(
            f"a frame has {image.shape[1]} x {image.shape[0]} px, not {size[0]} x {size[1]}",
            hint="All frames of a video need the size it was opened with.",
        )
    if not (0 <= time < 1e6) or (latest is not None and time <= latest):
        raise VideoError(
            f"a frame is timed {time} s after one at {latest} s",
            hint="Times must increase, from 0 s.",
        )
