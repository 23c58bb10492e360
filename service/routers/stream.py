"""``WS /v1/avatars/{id}/stream``: admission, hello, and why a stream ends."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import structlog
from cvthead_client.errors import WireError
from cvthead_client.hello import Hello, Welcome, error_json
from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from cvthead.errors import CVTHeadError, ModelChangedError
from cvthead.preset import AnyAvatar
from cvthead.provenance import SourceType
from service.keys import Tenant, authenticated, origin_allowed
from service.problems import Problem, from_core
from service.state import Service, ServiceDep
from service.streaming import CLOSE_CODES, POLICY_VIOLATION, Session

HELLO_SECONDS = 10.0
# A client that reads nothing any more would else keep the last message waiting for ever.
GOODBYE_SECONDS = 5.0
log = structlog.get_logger("cvthead")
router = APIRouter()


@router.websocket("/v1/avatars/{avatar_id}/stream")
async def stream(socket: WebSocket, avatar_id: str, service: ServiceDep, ticket: str = "") -> None:
    """Coefficients or driving frames in, rendered frames out; docs/streaming.md."""
    # Accepted before it is refused: browsers tell a page the close code, but not the HTTP status.
    await socket.accept()
    try:
        tenant = await _admit(service, socket, ticket)
        with _counted(service):
            avatar = await asyncio.to_thread(_avatar, service, avatar_id, tenant)
            hello = await _hello(socket)
            await socket.send_text(_welcome(avatar_id, hello).to_json())
            session = Session(service, socket, tenant.name, avatar_id, avatar, hello)
            try:
                await session.run()
            finally:
                log.info("stream", **vars(session.stats))
    except WebSocketDisconnect:
        return
    except Exception as error:
        await _refuse(socket, *_reason(error))


def _reason(error: Exception) -> tuple[str, str, str]:
    """Code, detail and hint of what ends a stream."""
    if isinstance(error, WireError):
        return error.code, str(error), error.hint
    if isinstance(error, CVTHeadError):
        problem = from_core(error)
    elif isinstance(error, Problem):
        problem = error
    else:
        log.error("internal", route="stream", exc_info=error)
        problem = Problem("internal")
    return problem.code, str(problem.detail), problem.hint


async def _admit(service: Service, socket: WebSocket, ticket: str) -> Tenant:
    """Who opens the stream.

    Raises:
        Problem: ``forbidden`` for a foreign page, ``unauthorized``, ``rate_limited``.
    """
    # A page of another site could open a stream in the name of a visitor on this network.
    if not origin_allowed(socket, service.settings.websocket_origins):
        raise Problem("forbidden", "the calling page's origin is not allowed")
    return await authenticated(socket, ticket=ticket)


@contextmanager
def _counted(service: Service) -> Iterator[None]:
    if service.open_streams >= service.settings.max_streams:
        raise Problem("overloaded", f"{service.open_streams} streams are open already")
    service.open_streams += 1
    service.metrics.streams.inc()
    try:
        yield
    finally:
        service.open_streams -= 1
        service.metrics.streams.dec()


def _avatar(service: Service, avatar_id: str, tenant: Tenant) -> AnyAvatar:
    avatar = service.cache.get(avatar_id, owner=tenant.name)
    if avatar.fingerprint != service.pipeline.fingerprint:
        raise ModelChangedError(
            "the avatar was made with other weights than are loaded now",
            hint="upload the portrait again",
        )
    return avatar


async def _hello(socket: WebSocket) -> Hello:
    try:
        async with asyncio.timeout(HELLO_SECONDS):
            event = await socket.receive()
    except TimeoutError as error:
        raise WireError("no hello came in time") from error
    if event["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(event.get("code", 1000))
    text = event.get("text")
    if text is None:
        raise WireError("the first message is binary, expected the hello as text")
    return Hello.from_json(text)


def _welcome(avatar_id: str, hello: Hello) -> Welcome:
    composite = hello.output.background == "source"
    source_type = SourceType.COMPOSITE if composite else SourceType.GENERATED
    return Welcome(hello.versions[0], avatar_id, str(source_type), hello.window, hello.output)


async def _refuse(socket: WebSocket, code: str, detail: str, hint: str) -> None:
    """Say why and close; a client that is gone or reads nothing is simply left."""
    socket.state.problem = code  # for the access log and the metrics
    with suppress(TimeoutError, WebSocketDisconnect, RuntimeError):
        async with asyncio.timeout(GOODBYE_SECONDS):
            await socket.send_text(error_json(code, detail, hint))
            await socket.close(CLOSE_CODES.get(code, POLICY_VIOLATION), code)
