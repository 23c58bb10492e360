"""Frames of a batch, rendered ahead of the reader but not far."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Iterable, Iterator

from service.engine import Engine, Rendered, RenderJob
from service.problems import Problem

# Frames that wait in the queue or for a slow reader: enough for the renderer never to wait.
AHEAD = 2
RETRY_SECONDS = 0.05


async def rendered_in_order(
    engine: Engine, jobs: Iterable[RenderJob]
) -> AsyncGenerator[Rendered, None]:
    """The pictures of ``jobs``. Closing the generator cancels those that have not begun.

    Raises:
        Problem: ``overloaded``, for the first job alone; later ones wait for room.
    """
    rest = iter(jobs)
    running: deque[asyncio.Task[Rendered]] = deque()
    try:
        for job in rest:
            yield await engine.render(job)
            break
        _refill(running, rest, engine)
        while running:
            rendered = await running[0]
            running.popleft()
            _refill(running, rest, engine)
            yield rendered
    finally:
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)


def _refill(
    running: deque[asyncio.Task[Rendered]], rest: Iterator[RenderJob], engine: Engine
) -> None:
    while len(running) < AHEAD and (job := next(rest, None)) is not None:
        running.append(asyncio.create_task(_patiently(engine, job)))


async def _patiently(engine: Engine, job: RenderJob) -> Rendered:
    while True:
        try:
            return await engine.render(job)
        except Problem as problem:
            if problem.code != "overloaded":
                raise
        await asyncio.sleep(RETRY_SECONDS)
