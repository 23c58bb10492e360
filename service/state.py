"""What the endpoints share: one Service per application."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import Depends
from starlette.requests import HTTPConnection

from cvthead.cache import AvatarCache
from cvthead.preset import Preset
from service.keys import KeyRing, Tickets
from service.limits import RateLimiter
from service.metrics import Metrics
from service.settings import Settings

if TYPE_CHECKING:
    from service.engine import Engine
    from service.signing import StillSigner


@dataclass(eq=False)
class Service:
    """Everything that lives as long as the application.

    Attributes:
        signer: of the stills that are sent; None where they are not signed.
        stopping: set when SIGTERM arrives; streams wait for it and close with 1001.
        in_flight: HTTP requests and streams being answered.
        open_streams: WebSocket streams that were admitted.
    """

    settings: Settings
    pipeline: Preset[Any]
    cache: AvatarCache
    engine: Engine
    metrics: Metrics
    keys: KeyRing
    tickets: Tickets
    limiter: RateLimiter
    signer: StillSigner | None = None
    stopping: asyncio.Event = field(default_factory=asyncio.Event)
    in_flight: int = 0
    open_streams: int = 0

    @property
    def draining(self) -> bool:
        """Whether the service takes no new work any more."""
        return self.stopping.is_set()


def get_service(connection: HTTPConnection) -> Service:
    """The service of a request or WebSocket."""
    service: Service = connection.app.state.service
    return service


async def _provided(connection: HTTPConnection) -> Service:
    # A coroutine, because FastAPI calls plain functions in a thread.
    return get_service(connection)


ServiceDep = Annotated[Service, Depends(_provided)]
