"""The engine with the real pipeline, without a server around it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

import numpy as np
import pytest
from made_pictures import pixels
from server_process import PORTRAIT

from cvthead.avatar import Avatar
from cvthead.errors import ImageTypeError, ModelChangedError, NoFaceError
from cvthead.images import read_image
from cvthead.pipeline import Pipeline
from cvthead.provenance import read_mark
from service.engine import Engine, Output, RenderJob
from service.metrics import Metrics


@asynccontextmanager
async def engine_of(pipeline: Pipeline) -> AsyncIterator[tuple[Engine, Metrics]]:
    metrics = Metrics()
    engine = Engine(pipeline, metrics, encode_queue=4, render_queue=16, max_batch=4)
    await engine.start()
    try:
        yield engine, metrics
    finally:
        await engine.stop(30)


def job_of(avatar: Avatar, output: Output | None = None) -> RenderJob:
    return RenderJob(avatar, (avatar.coefficients, avatar.camera), output or Output())


def run(pipeline: Pipeline, work: Callable[[Engine, Metrics], Awaitable[None]]) -> None:
    async def with_engine() -> None:
        async with engine_of(pipeline) as (engine, metrics):
            await work(engine, metrics)

    asyncio.run(with_engine())


def test_renders_of_several_avatars_are_painted_together(
    pipeline: Pipeline, avatar: Avatar
) -> None:
    """Alone or in company, an avatar's picture is the same; one that fails fails alone."""
    old = replace(avatar, fingerprint="0" * 16)
    nobody = replace(avatar, drawn=np.zeros_like(avatar.drawn))

    async def work(engine: Engine, metrics: Metrics) -> None:
        first = await engine.render(job_of(avatar))
        jobs = [job_of(a) for a in (avatar, nobody, old, avatar, avatar)]
        # The first of them occupies the thread, so that the others queue.
        results = await asyncio.gather(*map(engine.render, jobs), return_exceptions=True)
        assert isinstance(results.pop(2), ModelChangedError)
        files = [result.data for result in results if not isinstance(result, BaseException)]
        assert len(files) == 4
        for i in (0, 2, 3):
            assert np.abs(pixels(files[i]) - pixels(first.data)).max() <= 1
        assert np.abs(pixels(files[1]) - pixels(first.data)).mean() > 5
        value = metrics.registry.get_sample_value
        assert value("cvthead_batch_size_sum") == 5
        assert (value("cvthead_batch_size_count") or 9) <= 3

    run(pipeline, work)


def test_a_picture_comes_with_type_mark_and_timings(pipeline: Pipeline, avatar: Avatar) -> None:
    async def work(engine: Engine, metrics: Metrics) -> None:
        rendered = await engine.render(job_of(avatar, Output(64, "source", "jpeg", 70)))
        assert rendered.media_type == "image/jpeg"
        assert read_mark(rendered.data) == rendered.source
        assert list(rendered.timings) == ["queue", "pose", "paint", "encode"]
        raw = await engine.render(job_of(avatar, Output(64, (0, 255, 0), "raw")))
        image = np.frombuffer(raw.data, np.uint8).reshape(64, 64, 3)
        assert np.abs(image[0, 0].astype(int) - (0, 255, 0)).max() < 20

    run(pipeline, work)


def test_encoding_finds_the_face(pipeline: Pipeline) -> None:
    async def work(engine: Engine, metrics: Metrics) -> None:
        image = await engine.decode(PORTRAIT.read_bytes())
        face = await engine.track(image)
        encoded, box = await engine.encode(image, only_one=True)
        assert np.abs(np.subtract(box, face.box)).max() < 6
        assert encoded.fingerprint == pipeline.fingerprint
        again = await engine.track(image, face)
        assert np.array_equal(again.coefficients.shape, face.coefficients.shape)
        with pytest.raises(NoFaceError):
            await engine.encode(np.zeros((256, 256, 3), np.uint8))
        with pytest.raises(ImageTypeError):
            await engine.decode(b"text")

    run(pipeline, work)


def test_encoding_does_not_hold_up_renders(pipeline: Pipeline, avatar: Avatar) -> None:
    async def work(engine: Engine, metrics: Metrics) -> None:
        image = read_image(PORTRAIT)
        encodes = [asyncio.create_task(engine.encode(image)) for _ in range(3)]
        await asyncio.sleep(0)
        await engine.render(job_of(avatar))
        assert not all(task.done() for task in encodes)
        encodes[2].cancel()
        results = await asyncio.gather(*encodes, return_exceptions=True)
        assert isinstance(results[2], asyncio.CancelledError)
        value = metrics.registry.get_sample_value
        assert value("cvthead_stage_seconds_count", {"stage": "encode"}) == 2

    run(pipeline, work)
