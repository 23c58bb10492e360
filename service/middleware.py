"""Around every request: id, log line, metrics, security headers, hosts, limits, last resort.

Plain ASGI: Starlette's BaseHTTPMiddleware would copy bodies and hide disconnects.
"""

from __future__ import annotations

import asyncio
import re
import secrets
import time
from collections.abc import Mapping

import structlog
from fastapi import FastAPI
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect, HTTPConnection
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from service.keys import origin_allowed
from service.problems import Problem
from service.protocol import BROKEN_BODY
from service.settings import Settings
from service.state import Service, get_service

REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
CLIENT_GONE = 499  # nginx's code, for the log and the metrics; nobody receives it
ALWAYS_SERVED = ("/health/", "/metrics")  # also while stopping
METHODS = ("GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE", "WEBSOCKET")
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# The page at / sets its own, which allows its script and style.
NOTHING_LOADS = "default-src 'none'; frame-ancestors 'none'"
log = structlog.get_logger("cvthead")


def install(app: FastAPI, settings: Settings) -> None:
    """Put the middleware around the application; the first one listed here is the innermost."""
    app.add_middleware(
        BodyLimit, max_bytes=settings.max_body_bytes, seconds=settings.receive_seconds
    )
    app.add_middleware(Gate, settings=settings)
    app.add_middleware(Context)
    if settings.cors_origins:
        app.add_middleware(
            Cors,
            allow_origins=settings.cors_origins,
            allow_methods=["GET", "POST", "DELETE"],
            allow_headers=["Authorization", "Content-Type", "Idempotency-Key", "If-None-Match"],
            expose_headers=[
                "ETag",
                "Idempotency-Replayed",
                "Location",
                "Retry-After",
                "Server-Timing",
                "X-Digital-Source-Type",
                "X-Request-ID",
            ],
        )


def server_timing(stages: Mapping[str, float]) -> str:
    """The Server-Timing header (W3C) of milliseconds by stage."""
    return ", ".join(f"{stage};dur={milliseconds:.2f}" for stage, milliseconds in stages.items())


class Cors(CORSMiddleware):
    """Refuses a preflight with a problem instead of with plain text."""

    def preflight_response(self, request_headers: Headers) -> Response:
        response = super().preflight_response(request_headers)
        if response.status_code < 400:
            return response
        refused = Problem("forbidden", "the calling page's origin, method or header is not allowed")
        return refused.plain_response("", "", {"Vary": "Origin"})


class Context:
    """Request id, access log, metrics, headers; answers unexpected errors as ``internal``."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        request_id = given if REQUEST_ID.fullmatch(given) else secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = request_id
        with structlog.contextvars.bound_contextvars(request_id=request_id):
            await self._answer(scope, receive, send, request_id)

    async def _answer(self, scope: Scope, receive: Receive, send: Send, request_id: str) -> None:
        connection = HTTPConnection(scope)
        service = get_service(connection)
        is_http = scope["type"] == "http"
        begin, status = time.perf_counter(), 0

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                status = message["status"]
                _add_headers(message, scope, request_id, closing=is_http and service.draining)
            elif message["type"] == "websocket.accept":
                status = 101
            await send(message)

        service.in_flight += 1
        service.metrics.in_flight.inc(is_http)
        try:
            await self.app(scope, receive, sending)
        except ClientDisconnect:
            status = CLIENT_GONE
        except Exception:
            log.exception("internal", route=_route(scope))
            # An answer that has begun cannot be mended; cutting it off tells the client so.
            if status or not is_http:
                raise
            await Problem("internal").response(connection)(scope, receive, sending)
        finally:
            service.in_flight -= 1
            service.metrics.in_flight.dec(is_http)
            _record(service, scope, status or CLIENT_GONE, time.perf_counter() - begin)


def _add_headers(message: Message, scope: Scope, request_id: str, *, closing: bool) -> None:
    headers = MutableHeaders(raw=message.setdefault("headers", []))
    headers["X-Request-ID"] = request_id
    for name, value in SECURITY_HEADERS.items():
        headers.setdefault(name, value)
    if not headers.get("content-type", "").startswith("text/html"):
        headers.setdefault("Content-Security-Policy", NOTHING_LOADS)
    if scope["path"].startswith("/v1/"):
        headers.setdefault("Cache-Control", "no-store")
    if closing:
        headers["Connection"] = "close"


def _record(service: Service, scope: Scope, status: int, seconds: float) -> None:
    route, method = _route(scope), scope.get("method", "WEBSOCKET")
    method = method if method in METHODS else "OTHER"  # clients can invent any
    problem = scope["state"].get("problem")
    service.metrics.requests.labels(route, method, status).inc()
    if scope["type"] == "http":  # a stream's length says nothing of latency
        service.metrics.request_seconds.labels(route).observe(seconds)
    if problem:
        service.metrics.problems.labels(problem).inc()
    write = log.debug if route.startswith(ALWAYS_SERVED) else log.info
    fields = {"problem": problem} if problem else {}
    write(
        "request",
        method=method,
        route=route,
        status=status,
        milliseconds=round(seconds * 1000, 1),
        **fields,
    )


def _route(scope: Scope) -> str:
    """The route's template: a path would put ids into logs and metrics."""
    return getattr(scope.get("route"), "path", "unmatched")


class Gate:
    """Refuses foreign host names, foreign pages, and new work while the service stops."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        self.hosts = settings.hosts
        self.origins = settings.cors_origins
        self.open = not settings.keys

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        problem = self._problem(connection)
        if problem is None:
            await self.app(scope, receive, send)
            return
        response = problem.response(connection)
        if scope["type"] == "websocket":
            await WebSocket(scope, receive, send).send_denial_response(response)
        else:
            await response(scope, receive, send)

    def _problem(self, connection: HTTPConnection) -> Problem | None:
        if not self._known(connection.headers.get("host", "")):
            return Problem("forbidden", "the Host header names another host")
        # Without keys any page that the user visits could upload and render in their name.
        unsafe = connection.scope.get("method", "GET") not in SAFE_METHODS
        if self.open and unsafe and not origin_allowed(connection, self.origins):
            return Problem("forbidden", "the calling page's origin is not allowed")
        if get_service(connection).draining and not connection.url.path.startswith(ALWAYS_SERVED):
            return Problem("draining", headers={"Retry-After": "1"})
        return None

    def _known(self, host: str) -> bool:
        name = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
        name = name.lower()
        return any(
            pattern in ("*", name) or (pattern.startswith("*.") and name.endswith(pattern[1:]))
            for pattern in self.hosts
        )


class BodyLimit:
    """Refuses bodies over a size: declared ones at once, others as soon as they exceed it. And
    bodies that take too long to arrive, counted from when the application begins to read; and
    those that the protocol could not read on."""

    def __init__(self, app: ASGIApp, max_bytes: int, seconds: float) -> None:
        self.app = app
        self.max_bytes = max_bytes
        self.seconds = seconds

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        # Closing spares reading the rest of a body that nobody wants.
        problem = Problem(
            "body_too_large",
            f"the body is larger than {self.max_bytes} bytes",
            headers={"Connection": "close"},
        )
        declared = Headers(scope=scope).get("content-length", "")
        # Compared by length first: int() refuses thousands of digits.
        if len(declared) > 18 or (declared.isdecimal() and int(declared) > self.max_bytes):
            await problem.response(HTTPConnection(scope))(scope, receive, send)
            return
        received, more = 0, True
        deadline: float | None = None

        async def limited() -> Message:
            nonlocal received, more, deadline
            if not more:  # what may come now is that the client leaves, which has no time limit
                return await receive()
            deadline = deadline or asyncio.get_running_loop().time() + self.seconds
            try:
                async with asyncio.timeout_at(deadline):
                    message = await receive()
            except TimeoutError:
                headers = {"Connection": "close"}
                raise Problem("request_timeout", headers=headers) from None
            if scope["state"].get(BROKEN_BODY):
                raise Problem(
                    "malformed_body",
                    "the chunks of the body are not as HTTP/1.1 has them",
                    headers={"Connection": "close"},
                )
            more = message.get("more_body", False)
            received += len(message.get("body", b""))
            if received > self.max_bytes:
                raise problem
            return message

        await self.app(scope, limited, send)
