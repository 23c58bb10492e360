"""uvicorn with an orderly stop."""

from __future__ import annotations

import asyncio
import gc
import signal
import socket
import time
from types import FrameType

import structlog
import uvicorn

from service import logs
from service.app import create_app
from service.handshake import Handshake
from service.protocol import LimitedProtocol
from service.settings import Settings
from service.state import Service

# Requests that were on their way when the signal came still get an answer (503 `draining`).
LINGER_SECONDS = 0.3
POLL_SECONDS = 0.05
# A driving frame is a small JPEG; coefficients are 272 bytes.
MAX_WEBSOCKET_MESSAGE = 2 * 2**20
log = structlog.get_logger("cvthead")


def serve(settings: Settings, bound: socket.socket, banner: str) -> None:
    """Load the model, print the banner, serve until a signal."""
    logs.configure(settings.log_level, settings.log_format)
    app = create_app(settings)
    # What is loaded stays; a full collection that looks at it all holds every request up for 0.1 s.
    gc.collect()
    gc.freeze()
    config = uvicorn.Config(
        app,
        http=LimitedProtocol,
        ws=Handshake,
        ws_max_size=MAX_WEBSOCKET_MESSAGE,
        ws_per_message_deflate=False,  # pictures do not get smaller
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
        timeout_graceful_shutdown=1,  # after the drain nothing is left that is worth more
    )
    _Server(config, app.state.service, banner).run([bound])


class _Server(uvicorn.Server):
    """On the first signal: readiness off, work in flight is finished, then the sockets close.

    uvicorn alone closes its sockets at once, and a load balancer never sees the 503.
    """

    def __init__(self, config: uvicorn.Config, service: Service, banner: str) -> None:
        super().__init__(config)
        self._service = service
        self._banner = banner
        self._loop: asyncio.AbstractEventLoop | None = None
        self._drain: asyncio.Task[None] | None = None
        self._deadline = 0.0

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._loop = asyncio.get_running_loop()
        print(self._banner, flush=True)
        log.info("started", keys=bool(self._service.keys), store=str(self._service.cache.folder))

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        # The base class would end the process by the signal itself; a drained stop is exit 0.
        if self._loop is None:
            self.should_exit = True
        elif self._service.draining:
            self.should_exit = self.force_exit = True  # asked twice
        else:
            self._loop.call_soon_threadsafe(self._begin, sig)

    def _begin(self, sig: int) -> None:
        if not self._service.draining:
            self._service.stopping.set()
            self._deadline = time.monotonic() + self._service.settings.drain_seconds
            self._drain = asyncio.get_running_loop().create_task(self._wait(sig))

    async def _wait(self, sig: int) -> None:
        log.info("stopping", signal=signal.Signals(sig).name, in_flight=self._service.in_flight)
        await asyncio.sleep(LINGER_SECONDS)
        await self._idle()
        # Nobody new; but a connection that was just accepted has its request still to come.
        for server in self.servers:
            server.close()
        await asyncio.sleep(LINGER_SECONDS)
        await self._idle()
        log.info("stopped", abandoned=self._service.in_flight)
        self.should_exit = True

    async def _idle(self) -> None:
        """Return when nothing is in flight, or when the time is over."""
        while self._service.in_flight and time.monotonic() < self._deadline:
            await asyncio.sleep(POLL_SECONDS)
