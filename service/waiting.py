"""Waiting for work on behalf of a client that may leave."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from starlette.requests import ClientDisconnect, Request

T = TypeVar("T")


async def unless_gone(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """The result of ``work``, which is cancelled as soon as the client has gone.

    Args:
        request: its body must have been read completely.

    Raises:
        ClientDisconnect: it has gone; there is nobody to answer.
    """
    waiting = asyncio.current_task()
    assert waiting is not None

    def leave(_: asyncio.Task[None]) -> None:
        waiting.cancel()

    gone = asyncio.ensure_future(_gone(request))
    gone.add_done_callback(leave)
    try:
        return await work
    except asyncio.CancelledError:
        if not gone.done():
            raise  # by somebody else
        waiting.uncancel()
        raise ClientDisconnect from None
    finally:
        gone.remove_done_callback(leave)
        gone.cancel()


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
