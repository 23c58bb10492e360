"""The queue and its thread, with jobs that are numbers and events."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from service.metrics import Metrics
from service.problems import Problem
from service.worker import Item, Worker


class Recorder:
    """Handles jobs: records the batches, waits for events, raises errors, echoes the rest."""

    def __init__(self) -> None:
        self.batches: list[list[object]] = []
        self.begun = threading.Event()

    def __call__(self, items: Sequence[Item]) -> None:
        self.batches.append([item.job for item in items])
        self.begun.set()
        for item in items:
            if isinstance(item.job, threading.Event):
                assert item.job.wait(10)
            if isinstance(item.job, Exception):
                raise item.job
            item.future.set_result(item.job)


def sample(metrics: Metrics, name: str) -> float:
    return metrics.registry.get_sample_value(name, {"queue": "render"}) or 0.0


@contextmanager
def running(limit: int = 8, max_batch: int = 1) -> Iterator[tuple[Worker, Recorder, Metrics]]:
    metrics, recorder = Metrics(), Recorder()
    worker = Worker(
        "render", limit, recorder, metrics, batched=int, max_batch=max_batch, niceness=1
    )
    worker.start()
    try:
        yield worker, recorder, metrics
    finally:
        worker.stop(5)


def stopping(worker: Worker) -> bool:
    try:
        worker.check()
    except Problem as problem:
        return problem.code == "draining"
    return False


def run(work: Callable[[], Awaitable[None]]) -> None:
    async def limited() -> None:
        await asyncio.wait_for(work(), 20)

    asyncio.run(limited())


async def begun(recorder: Recorder) -> None:
    assert await asyncio.to_thread(recorder.begun.wait, 10)


def test_results_come_back_and_the_loop_goes_on() -> None:
    async def work() -> None:
        with running() as (worker, recorder, _):
            gate = threading.Event()
            blocked = asyncio.create_task(worker.submit(gate))
            await begun(recorder)
            for _ in range(3):
                await asyncio.sleep(0)  # would hang if the job ran in the loop
            gate.set()
            assert await blocked is gate
            assert await worker.submit("later") == "later"

    run(work)


def test_consecutive_jobs_of_the_batched_type_come_together() -> None:
    async def work() -> None:
        with running(max_batch=3) as (worker, recorder, _):
            gate = threading.Event()
            jobs = [gate, 1, 2, "track", 3, 4, 5, 6]
            tasks = [asyncio.create_task(worker.submit(job)) for job in jobs[:1]]
            await begun(recorder)
            tasks += [asyncio.create_task(worker.submit(job)) for job in jobs[1:]]
            await asyncio.sleep(0)
            gate.set()
            assert await asyncio.gather(*tasks) == jobs
            assert recorder.batches == [[gate], [1, 2], ["track"], [3, 4, 5], [6]]

    run(work)


def test_a_full_queue_refuses_at_once() -> None:
    async def work() -> None:
        with running(limit=2) as (worker, recorder, metrics):
            gate = threading.Event()
            tasks = [asyncio.create_task(worker.submit(gate))]
            await begun(recorder)
            tasks += [asyncio.create_task(worker.submit(i)) for i in range(2)]
            await asyncio.sleep(0)
            for refused in (worker.check, lambda: worker.submit(9).send(None)):
                with pytest.raises(Problem) as caught:
                    refused()
                assert caught.value.code == "overloaded"
                assert int((caught.value.headers or {})["Retry-After"]) >= 1
            assert sample(metrics, "cvthead_overloaded_total") == 2
            assert sample(metrics, "cvthead_queue_depth") == 2
            gate.set()
            await asyncio.gather(*tasks)
            worker.check()

    run(work)


def test_cancelled_jobs_are_skipped_and_make_room() -> None:
    async def work() -> None:
        with running(limit=2) as (worker, recorder, metrics):
            gate = threading.Event()
            first = asyncio.create_task(worker.submit(gate))
            await begun(recorder)
            gone = [asyncio.create_task(worker.submit(i)) for i in range(2)]
            await asyncio.sleep(0)
            for task in gone:
                task.cancel()
            await asyncio.sleep(0)
            late = asyncio.create_task(worker.submit("late"))  # although two are in the queue
            await asyncio.sleep(0)
            gate.set()
            assert list(await asyncio.gather(first, late)) == [gate, "late"]
            assert recorder.batches == [[gate], ["late"]]
            assert sample(metrics, "cvthead_cancelled_total") == 2

    run(work)


def test_an_error_reaches_its_job_and_the_thread_goes_on() -> None:
    async def work() -> None:
        with running() as (worker, _, _):
            with pytest.raises(ZeroDivisionError):
                await worker.submit(ZeroDivisionError())
            assert await worker.submit("next") == "next"

    run(work)


def test_stop_finishes_what_is_queued() -> None:
    async def work() -> None:
        with running() as (worker, recorder, _), ThreadPoolExecutor(1) as pool:
            gate = threading.Event()
            tasks = [asyncio.create_task(worker.submit(gate))]
            await begun(recorder)
            tasks.append(asyncio.create_task(worker.submit("queued")))
            await asyncio.sleep(0)
            stopped = asyncio.get_running_loop().run_in_executor(pool, worker.stop, 10)
            while not stopping(worker):
                await asyncio.sleep(0.01)
            gate.set()
            await stopped
            assert await asyncio.gather(*tasks) == [gate, "queued"]

    run(work)


def test_stop_refuses_what_it_cannot_finish() -> None:
    async def work() -> None:
        with running() as (worker, recorder, _):
            gate = threading.Event()
            running_one = asyncio.create_task(worker.submit(gate))
            await begun(recorder)
            waiting = asyncio.create_task(worker.submit("waiting"))
            await asyncio.sleep(0)
            await asyncio.to_thread(worker.stop, 0.05)
            with pytest.raises(Problem) as caught:
                await waiting
            assert caught.value.code == "draining"
            gate.set()
            assert await running_one is gate

    run(work)
