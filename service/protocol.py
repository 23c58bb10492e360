"""HTTP/1.1 on a socket: uvicorn's protocol with limits on slow and on endless requests, and on
answers that nobody reads."""

from __future__ import annotations

import asyncio
import secrets
from typing import Any

from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.server import ServerState

from service.problems import Problem
from service.settings import Settings

MAX_HEAD_BYTES = 2**16
# In a request's state when its body is not HTTP/1.1.
BROKEN_BODY = "broken_body"
# The application itself answers a slow body (service/middleware.py); it gets this long for it.
GRACE_SECONDS = 5.0


class LimitedProtocol(HttpToolsProtocol):
    """Gives a request's head, and then its body, ``receive_seconds`` to arrive; and the client
    ``send_seconds`` to make room when the socket takes no more of the answer.

    Without a limit, clients that send a byte now and then hold connections for ever. What cannot
    be read is answered here, because no application is called for it; uvicorn alone would answer
    in plain text.
    """

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        settings: Settings = config.app.state.service.settings  # type: ignore[union-attr]
        self._seconds = settings.receive_seconds
        self._send_seconds = settings.send_seconds
        self._timer: asyncio.TimerHandle | None = None
        self._unread: asyncio.TimerHandle | None = None
        self._head_bytes = 0
        self._in_head = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._limit(self._seconds)

    def connection_lost(self, exc: Exception | None) -> None:
        self._limit(None)
        self._taken()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._timer is None:  # also for empty lines, with which no request begins
            self._limit(self._seconds)
        super().data_received(data)
        if self._in_head and not self.transport.is_closing():
            self._head_bytes += len(data)
            if self._head_bytes > MAX_HEAD_BYTES:
                self._refuse(Problem("headers_too_large"))

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._in_head, self._head_bytes = True, 0
        if self._timer is None:  # the request was sent together with the one before
            self._limit(self._seconds)

    def on_headers_complete(self) -> None:
        self._in_head = False
        super().on_headers_complete()
        self._limit(self._seconds + GRACE_SECONDS)

    def on_message_complete(self) -> None:
        self._limit(None)
        super().on_message_complete()

    def handle_websocket_upgrade(self) -> None:
        self._limit(None)
        self._taken()
        super().handle_websocket_upgrade()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._unread = self.loop.call_later(self._send_seconds, self.transport.abort)

    def resume_writing(self) -> None:
        self._taken()
        super().resume_writing()

    def _taken(self) -> None:
        if self._unread is not None:
            self._unread.cancel()

    def send_400_response(self, msg: str) -> None:
        cycle = self.cycle
        if cycle is None or not cycle.more_body:
            self._refuse(Problem("malformed_request"))
        elif cycle.response_complete:  # of a body that nobody wanted
            self.transport.close()
        else:  # the application answers, under the request's id
            cycle.scope["state"][BROKEN_BODY] = True
            cycle.keep_alive = False
            cycle.message_event.set()

    def _limit(self, seconds: float | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if seconds is None else self.loop.call_later(seconds, self._too_slow)

    def _too_slow(self) -> None:
        if self._in_head:
            self._refuse(Problem("request_timeout"))
        else:  # nothing was asked, or the answer is already given
            self.transport.close()

    def _refuse(self, problem: Problem) -> None:
        if self.cycle is None or self.cycle.response_complete:
            self.transport.write(last_answer(problem, "", secrets.token_hex(8)))
        self.transport.close()


def last_answer(problem: Problem, instance: str, request_id: str) -> bytes:
    """A problem as it is sent on a connection that is closed after it."""
    headers = {**(problem.headers or {}), "Connection": "close", "X-Request-ID": request_id}
    response = problem.plain_response(instance, request_id, headers)
    head = f"HTTP/1.1 {response.status_code} {problem.title}\r\n".encode()
    fields = b"".join(name + b": " + value + b"\r\n" for name, value in response.raw_headers)
    return head + fields + b"\r\n" + bytes(response.body)
