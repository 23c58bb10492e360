"""The pipeline behind queues: encoding is slow and of low priority, rendering fast."""

from __future__ import annotations

import asyncio
import time
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.coefficients import Array, Coefficients
from cvthead.composite import Background, Composer
from cvthead.controls import Controls, resolve
from cvthead.frame import Frame
from cvthead.head.model import HeadModel, Region
from cvthead.images import ImageFormat, decode_image, encode_image
from cvthead.preset import AnyAvatar, Preset
from cvthead.provenance import SourceType
from cvthead.record import Box
from cvthead.tracking.tracker import FaceTurnedWarning, TrackedFace
from service.metrics import Metrics
from service.problems import Problem
from service.worker import Item, Worker

# Pictures decoded at once. Each takes up to 150 MB (cvthead.images.MAX_PIXELS).
DECODERS = 2
NO_BACKGROUND = np.zeros((1, 1, 3), np.uint8)
MEDIA_TYPES = {
    "png": "image/png",
    "jpeg": "image/jpeg",
    "webp": "image/webp",
    "raw": "application/octet-stream",
}


@dataclass(frozen=True)
class Output:
    """The picture that is wanted of a frame.

    Attributes:
        size: side in pixels.
        background: colour, "transparent" or "source" (the portrait's own).
        format: "raw" gives uncompressed RGB (RGBA when transparent) for further processing.
        quality: 1 to 100 for JPEG and WebP.
    """

    size: int = 256
    background: Background = "transparent"
    format: ImageFormat | Literal["raw"] = "png"
    quality: int = 90


Pose = tuple[Coefficients, Camera]


@dataclass(frozen=True, eq=False)
class RenderJob:
    """One frame of an avatar.

    Attributes:
        wanted: full coefficients and normalised camera; or controls, which the worker resolves,
            because that takes the event loop too long.
    """

    avatar: AnyAvatar
    wanted: Pose | Controls
    output: Output


@dataclass(frozen=True, eq=False)
class Rendered:
    """A finished picture.

    Attributes:
        data: the file; every format but "raw" carries the AI-generated mark ``source``.
        timings: milliseconds of queue, pose, paint and encode.
    """

    data: bytes
    media_type: str
    source: SourceType
    timings: dict[str, float]


@dataclass(frozen=True, eq=False)
class _Encode:
    image: NDArray[np.uint8]
    face: int | None
    only_one: bool


@dataclass(frozen=True, eq=False)
class _Track:
    image: NDArray[np.uint8]
    previous: TrackedFace | None
    shape: Array | None
    face: int | None


class Engine:
    """Encodes, tracks and renders for coroutines. Overload is refused at once.

    Args:
        encode_queue, render_queue: jobs that may wait.
        max_batch: renders painted at once.
        encode_niceness: lowers the priority of encoding; the pipeline's own threads have theirs
            from when it was loaded.

    All methods raise Problem ``overloaded`` (with Retry-After) when their queue is full and
    ``draining`` once the engine stops, beside what their core function raises. A cancelled call
    is skipped if it has not begun.
    """

    def __init__(
        self,
        pipeline: Preset[Any],
        metrics: Metrics,
        *,
        encode_queue: int,
        render_queue: int,
        max_batch: int,
        encode_niceness: int = 0,
    ) -> None:
        self.pipeline = pipeline
        self.max_batch = max_batch
        self._metrics = metrics
        self._encoding = Worker(
            "encode", encode_queue, self._encode, metrics, niceness=encode_niceness
        )
        self._rendering = Worker(
            "render",
            render_queue,
            self._render_or_track,
            metrics,
            batched=RenderJob,
            max_batch=max_batch,
        )
        self._decoders = ThreadPoolExecutor(DECODERS, "cvthead-decode")
        self._decoding = 0

    async def start(self) -> None:
        # A turned head is a value in the answer; the log of a service has no use for it.
        warnings.simplefilter("ignore", FaceTurnedWarning)
        self._encoding.start()
        self._rendering.start()

    async def stop(self, drain: float) -> None:
        """Take no more work, finish what is queued within ``drain`` seconds, refuse the rest."""
        await asyncio.gather(
            asyncio.to_thread(self._encoding.stop, drain),
            asyncio.to_thread(self._rendering.stop, drain),
        )
        self._decoders.shutdown(wait=False, cancel_futures=True)

    def check_encode(self) -> None:
        """Refuse an upload that could not be queued, before its body is read and decoded."""
        self._encoding.check()

    def check_render(self) -> None:
        """The same for driving frames."""
        self._rendering.check()

    async def decode(self, data: bytes, *, longest: int | None = None) -> NDArray[np.uint8]:
        """``cvthead.images.decode_image`` in a thread, few at a time.

        Raises:
            ImageError: as there.
        """
        if self._decoding >= DECODERS + self._rendering.limit:
            self._metrics.overloaded.labels("render").inc()
            raise Problem("overloaded", headers={"Retry-After": "1"})
        self._decoding += 1
        try:
            loop = asyncio.get_running_loop()
            decoding = partial(decode_image, data, longest=longest)
            return await loop.run_in_executor(self._decoders, decoding)
        finally:
            self._decoding -= 1

    async def encode(
        self, image: NDArray[np.uint8], *, face: int | None = None, only_one: bool = False
    ) -> tuple[AnyAvatar, Box]:
        """``Pipeline.encode``, and the box of the face in pixels of the image.

        Raises:
            ImageError, FaceError: as there.
        """
        result: tuple[AnyAvatar, Box] = await self._encoding.submit(_Encode(image, face, only_one))
        return result

    async def track(
        self,
        image: NDArray[np.uint8],
        previous: TrackedFace | None = None,
        shape: Array | None = None,
        *,
        face: int | None = None,
    ) -> TrackedFace:
        """``Tracker.track``.

        Raises:
            ImageError, FaceError: as there.
        """
        result: TrackedFace = await self._rendering.submit(_Track(image, previous, shape, face))
        return result

    async def render(self, job: RenderJob) -> Rendered:
        """A picture of an avatar, ready to send.

        Raises:
            ModelChangedError, AvatarFileError: as ``Pipeline.pose``.
            CoefficientsError: as ``cvthead.controls.resolve``.
        """
        result: Rendered = await self._rendering.submit(job)
        return result

    def _encode(self, items: Sequence[Item]) -> None:
        for item in items:
            job: _Encode = item.job
            with self._stage("encode"):
                avatar = self.pipeline.encode(job.image, face=job.face, only_one=job.only_one)
            item.future.set_result((avatar, face_box(self.pipeline.head, avatar)))

    def _render_or_track(self, items: Sequence[Item]) -> None:
        if isinstance(items[0].job, RenderJob):
            self._render(items)
            return
        for item in items:
            job: _Track = item.job
            with self._stage("track"):
                face = self.pipeline.tracker.track(
                    job.image, face=job.face, shape=job.shape, previous=job.previous
                )
            item.future.set_result(face)

    def _render(self, items: Sequence[Item]) -> None:
        begin = time.perf_counter()
        posed: list[tuple[Item, Array, dict[str, float]]] = []
        for item in items:
            timings = {"queue": (begin - item.queued) * 1000}
            job: RenderJob = item.job
            try:
                with self._stage("pose", timings):
                    points = self.pipeline.pose(job.avatar, *self._pose(job))
            except Exception as error:  # one avatar's fault is not its neighbours'
                item.future.set_exception(error)
            else:
                posed.append((item, points, timings))
        if not posed:
            return
        self._metrics.batch_size.observe(len(posed))
        painting: dict[str, float] = {}
        with self._stage("paint", painting):
            frames = self.pipeline.paint_many(
                [(item.job.avatar, points) for item, points, _ in posed]
            )
        for (item, _, timings), frame in zip(posed, frames, strict=True):
            timings |= painting
            with self._stage("image", timings):
                data, source = picture(self.pipeline, item.job, frame)
            timings["encode"] = timings.pop("image")
            media_type = MEDIA_TYPES[item.job.output.format]
            item.future.set_result(Rendered(data, media_type, source, timings))

    def _pose(self, job: RenderJob) -> Pose:
        if not isinstance(job.wanted, Controls):
            return job.wanted
        avatar = job.avatar
        return resolve(avatar.coefficients, avatar.camera, job.wanted, self.pipeline.arkit)

    @contextmanager
    def _stage(self, name: str, timings: dict[str, float] | None = None) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        seconds = time.perf_counter() - begin
        self._metrics.stage_seconds.labels(name).observe(seconds)
        if timings is not None:
            timings[name] = seconds * 1000


def picture(pipeline: Preset[Any], job: RenderJob, frame: Frame) -> tuple[bytes, SourceType]:
    """The file of a frame, and what its AI-generated mark says."""
    output = job.output
    own = pipeline.background(job.avatar) if output.background == "source" else NO_BACKGROUND
    composer = Composer.of(output.background, output.size, own)
    image = composer.picture(frame)
    if output.format == "raw":
        return image.tobytes(), composer.source
    data = encode_image(image, output.format, quality=output.quality, source=composer.source)
    return data, composer.source


def face_box(head: HeadModel, avatar: AnyAvatar) -> Box:
    """Left, top, right, bottom of the fitted face in pixels of the portrait: of its landmarks, or
    of its region where the head model has none of them (FLAME)."""
    vertices = head.vertices(avatar.coefficients)
    has_landmarks = len(head.landmark_faces) > 0
    face = head.landmarks(vertices) if has_landmarks else vertices[head.region == Region.FACE]
    crop = avatar.crop
    pixels = (avatar.camera.project(face)[:, :2] + 1) / 2 * crop.size + (crop.left, crop.top)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
