"""What many frames are sent in: multipart/mixed, zip, MP4."""

from __future__ import annotations

import asyncio
import secrets
import sys
import tempfile
import zipfile
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import aclosing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from cvthead.provenance import SourceType
from cvthead.video_writer import video_writer
from service.engine import Rendered

T = TypeVar("T")
Frames = AsyncGenerator[Rendered, None]

MULTIPART_TYPE, ZIP_TYPE, VIDEO_TYPE = "multipart/mixed", "application/zip", "video/mp4"
CHUNK = 256 * 1024


class Parts(Protocol):
    """A container that grows frame by frame."""

    media_type: str

    def stream(self, frames: Frames) -> AsyncGenerator[bytes, None]: ...


class Multipart:
    """RFC 2046: each frame is a part with its number and type."""

    def __init__(self) -> None:
        self._boundary = secrets.token_hex(16)
        self.media_type = f"{MULTIPART_TYPE}; boundary={self._boundary}"

    async def stream(self, frames: Frames) -> AsyncGenerator[bytes, None]:
        async with aclosing(frames):
            number = 0
            async for frame in frames:
                head = (
                    f"--{self._boundary}\r\n"
                    f"Content-Type: {frame.media_type}\r\n"
                    f"Content-Length: {len(frame.data)}\r\n"
                    f'Content-Disposition: attachment; filename="{file_name(number, frame)}"\r\n'
                    "\r\n"
                )
                yield head.encode() + frame.data + b"\r\n"
                number += 1
            yield f"--{self._boundary}--\r\n".encode()


class Zip:
    """Stored, not compressed: the frames are. Sizes follow each file, so nothing is kept back."""

    media_type = ZIP_TYPE

    async def stream(self, frames: Frames) -> AsyncGenerator[bytes, None]:
        written = _Written()
        async with aclosing(frames):
            with zipfile.ZipFile(written, "w") as archive:  # type: ignore[call-overload]
                number = 0
                async for frame in frames:
                    archive.writestr(file_name(number, frame), frame.data)
                    yield written.taken()
                    number += 1
            yield written.taken()


PARTS: dict[str, type[Multipart] | type[Zip]] = {MULTIPART_TYPE: Multipart, ZIP_TYPE: Zip}


@dataclass(frozen=True)
class VideoFile:
    """A finished MP4 in a folder of its own, which is removed once it is sent."""

    folder: tempfile.TemporaryDirectory[str]
    path: Path

    async def chunks(self) -> AsyncIterator[bytes]:
        try:
            file = await asyncio.to_thread(self.path.open, "rb")
            with file:
                while chunk := await asyncio.to_thread(file.read, CHUNK):
                    yield chunk
        finally:
            self.folder.cleanup()


async def video(frames: Frames, size: int, fps: float, source: SourceType) -> VideoFile:
    """Write an MP4 of raw RGB frames; encoding happens in threads.

    Raises:
        VideoError: it cannot be encoded.
    """
    folder = tempfile.TemporaryDirectory(prefix="cvthead-")
    path = Path(folder.name) / "frames.mp4"
    try:
        async with aclosing(frames):
            writer = video_writer(path, size=(size, size), fps=fps, source=source)
            write = await _in_thread(writer.__enter__)
            try:
                async for frame in frames:
                    image = np.frombuffer(frame.data, np.uint8).reshape(size, size, 3)
                    await _in_thread(write, image)
            except BaseException:
                await _in_thread(writer.__exit__, *sys.exc_info())
                raise
            await _in_thread(writer.__exit__, None, None, None)
    except BaseException:
        folder.cleanup()
        raise
    return VideoFile(folder, path)


def file_name(number: int, frame: Rendered) -> str:
    return f"{number:06d}.{frame.media_type.removeprefix('image/')}"


async def _in_thread(function: Callable[..., T], *arguments: Any) -> T:
    """As asyncio.to_thread, but when cancelled it ends only with the thread: the writer must not
    be closed while it writes."""
    task = asyncio.ensure_future(asyncio.to_thread(function, *arguments))
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.wait([task])
        raise


class _Written:
    """Takes what ZipFile writes, which cannot seek in it."""

    def __init__(self) -> None:
        self._chunks: list[bytes] = []

    def write(self, data: bytes) -> int:
        self._chunks.append(bytes(data))
        return len(data)

    def flush(self) -> None:
        pass

    def taken(self) -> bytes:
        data, self._chunks = b"".join(self._chunks), []
        return data
