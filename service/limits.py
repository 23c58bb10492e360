"""Requests per minute, by key or client address."""

from __future__ import annotations

import time

from limits import RateLimitItemPerMinute
from limits.aio.storage import MemoryStorage
from limits.aio.strategies import SlidingWindowCounterRateLimiter

from service.problems import Problem, retry_after


class RateLimiter:
    """Counts the requests of each client in a sliding window of a minute.

    Args:
        per_minute: requests allowed; 0 sets no limit.
    """

    def __init__(self, per_minute: int) -> None:
        self._item = RateLimitItemPerMinute(per_minute) if per_minute else None
        self._limiter = SlidingWindowCounterRateLimiter(MemoryStorage())

    async def check(self, client: str) -> None:
        """Count a request of ``client``.

        Raises:
            Problem: ``rate_limited``, with Retry-After.
        """
        if self._item is None or await self._limiter.hit(self._item, client):
            return
        reset = (await self._limiter.get_window_stats(self._item, client)).reset_time
        raise Problem(
            "rate_limited",
            f"more than {self._item.amount} requests in a minute",
            headers=retry_after(reset - time.time()),
        )
