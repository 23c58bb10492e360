"""A bounded queue with one thread behind it."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from cvthead.runtime.sessions import lower_priority
from service.metrics import Metrics, Queue
from service.problems import Problem, retry_after

# Weight of the newest job in the running mean of a job's seconds.
NEWEST = 0.1


@dataclass(eq=False)
class Item:
    """A job in the queue, and where its result goes."""

    job: Any
    future: Future[Any] = field(default_factory=Future)
    queued: float = field(default_factory=time.perf_counter)


class Worker:
    """Runs jobs one after the other, in a thread of its own, so that the event loop never waits.

    Args:
        name: of the queue, for the metrics.
        limit: jobs that may wait; one more is refused at once.
        handle: does jobs and sets their futures. Consecutive jobs of the type ``batched`` come
            together, others alone.
        max_batch: how many come together at most.
        niceness: lowers the thread's priority (Linux).
    """

    def __init__(
        self,
        name: Queue,
        limit: int,
        handle: Callable[[Sequence[Item]], None],
        metrics: Metrics,
        *,
        batched: type | None = None,
        max_batch: int = 1,
        niceness: int = 0,
    ) -> None:
        self.name = name
        self.limit = limit
        self._handle = handle
        self._metrics = metrics
        self._batched = batched
        self._max_batch = max_batch
        self._niceness = niceness
        self._items: deque[Item] = deque()
        self._changed = threading.Condition()
        self._busy = self._stopping = False
        self._seconds = 0.1
        self._thread = threading.Thread(target=self._run, name=f"cvthead-{name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def check(self) -> None:
        """Refuse work that could not be queued now, before its picture is decoded.

        Raises:
            Problem: ``overloaded`` with Retry-After, ``draining``.
        """
        with self._changed:
            self._check()

    async def submit(self, job: Any) -> Any:
        """Queue a job and wait for its result. Cancelling skips a job that has not begun.

        Raises:
            Problem: ``overloaded`` with Retry-After, ``draining``; and what the job raises.
        """
        item = Item(job)
        with self._changed:
            self._check()
            self._items.append(item)
            self._metrics.queue_depth.labels(self.name).set(len(self._items))
            self._changed.notify_all()
        return await asyncio.wrap_future(item.future)

    def stop(self, seconds: float) -> None:
        """Take no more work, finish what is queued within ``seconds``, refuse the rest."""
        deadline = time.monotonic() + seconds
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: not (self._items or self._busy), seconds)
            rest, self._items = self._items, deque()
        for item in rest:
            if item.future.set_running_or_notify_cancel():
                item.future.set_exception(Problem("draining", headers={"Retry-After": "1"}))
        if self._thread.is_alive():
            self._thread.join(max(0.0, deadline - time.monotonic()))

    def _check(self) -> None:
        if self._stopping:
            raise Problem("draining", headers={"Retry-After": "1"})
        if len(self._items) >= self.limit:
            self._drop_cancelled()
        if len(self._items) >= self.limit:
            self._metrics.overloaded.labels(self.name).inc()
            raise Problem("overloaded", headers=retry_after(self._seconds * len(self._items)))

    def _drop_cancelled(self) -> None:
        live = deque(item for item in self._items if not item.future.cancelled())
        self._metrics.cancelled.labels(self.name).inc(len(self._items) - len(live))
        self._items = live

    def _run(self) -> None:
        lower_priority(self._niceness)
        while self._do(self._take()):
            pass

    def _do(self, items: Sequence[Item]) -> bool:
        if not items:
            return False
        begin = time.perf_counter()
        for item in items:
            self._metrics.queue_seconds.labels(self.name).observe(begin - item.queued)
        try:
            self._handle(items)
        except Exception as error:
            for item in items:
                if not item.future.done():
                    item.future.set_exception(error)
        each = (time.perf_counter() - begin) / len(items)
        self._seconds += NEWEST * (each - self._seconds)
        return True

    def _take(self) -> list[Item]:
        """The next jobs; empty when there will be none."""
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            taken: list[Item] = []
            while not taken:
                self._changed.wait_for(lambda: self._items or self._stopping)
                if not self._items:
                    return []
                self._fill(taken)
            self._busy = True
            self._metrics.queue_depth.labels(self.name).set(len(self._items))
            return taken

    def _fill(self, taken: list[Item]) -> None:
        while self._items and len(taken) < self._max_batch:
            if taken and not self._together(taken[0].job, self._items[0].job):
                return
            item = self._items.popleft()
            if item.future.set_running_or_notify_cancel():
                taken.append(item)
            else:
                self._metrics.cancelled.labels(self.name).inc()

    def _together(self, first: Any, second: Any) -> bool:
        batched = self._batched
        return batched is not None and isinstance(first, batched) and isinstance(second, batched)
