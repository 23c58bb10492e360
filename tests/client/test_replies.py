"""Errors and repetitions of both clients, against a server that misbehaves on purpose."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from collections.abc import Callable
from email.utils import formatdate
from typing import Any

import pytest
from cvthead_client import AsyncClient, Client, Retry, errors
from cvthead_client.replies import retry_after, timings
from scripted_server import Reply, problem, scripted

from service.problem_codes import PROBLEMS
from service.problems import Problem

AVATAR: dict[str, Any] = {
    "id": "a" * 32,
    "created": "2026-11-23T12:00:00Z",
    "expires": None,
    "bytes": 1,
    "preset": "open",
    "fingerprint": "0" * 16,
    "face_box": [1, 2, 3, 4],
    "links": {},
}
CREATED = Reply(201, json.dumps(AVATAR).encode(), {"Content-Type": "application/json"})
DELETED = Reply(204)
PICTURE = b"\xff\xd8\xff"
QUICK = Retry(attempts=2, pause=0.01)
Call = Callable[..., Any]


def blocking(url: str, method: str, *args: object, retry: Retry = QUICK) -> Any:
    with Client(url, retry=retry, timeout=1) as client:
        return getattr(client, method)(*args)


def asynchronous(url: str, method: str, *args: object, retry: Retry = QUICK) -> Any:
    async def run() -> Any:
        async with AsyncClient(url, retry=retry, timeout=1) as client:
            return await getattr(client, method)(*args)

    return asyncio.run(run())


@pytest.fixture(params=[blocking, asynchronous], ids=["sync", "async"])
def call(request: pytest.FixtureRequest) -> Call:
    chosen: Call = request.param
    return chosen


@pytest.mark.parametrize("code", PROBLEMS)
def test_every_problem_of_the_service_has_its_exception(code: str) -> None:
    wanted = errors.BY_CODE[code]
    body = Problem(code).body("/v1/avatars", "request-1")
    reply = Reply(PROBLEMS[code].status, json.dumps(body).encode())
    with scripted(reply) as server, pytest.raises(errors.ServiceError) as raised:
        blocking(server.url, "get", "x", retry=Retry(attempts=0))
    error = raised.value
    assert type(error) is wanted
    assert (error.code, error.status) == (code, PROBLEMS[code].status)
    assert error.request_id == "request-1"
    assert error.hint
    assert str(error) == body["detail"]


def test_every_exception_is_raised_for_some_problem() -> None:
    """And is drawn in the docstring."""
    classes = {
        kind
        for kind in vars(errors).values()
        if isinstance(kind, type) and issubclass(kind, errors.ServiceError)
    }
    parents = {base for kind in classes for base in kind.__bases__}
    # FaceError is a parent that the service also raises as such.
    assert classes - parents <= set(errors.BY_CODE.values())
    for name, kind in vars(errors).items():
        if isinstance(kind, type) and issubclass(kind, errors.CVTHeadClientError):
            assert name in (errors.__doc__ or "")


def test_extra_members_can_be_read() -> None:
    several = errors.service_error({"code": "several_faces", "boxes": [[1, 2, 3, 4], "x"]})
    assert isinstance(several, errors.SeveralFacesError)
    assert several.boxes == [(1, 2, 3, 4)]
    fields = [{"pointer": "/shape", "message": "too short"}]
    invalid = errors.service_error({"code": "invalid_request", "errors": fields})
    assert isinstance(invalid, errors.InvalidRequestError)
    assert invalid.errors == fields


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (401, errors.UnauthorizedError),
        (418, errors.InvalidRequestError),
        (503, errors.UnavailableError),
        (502, errors.InternalServiceError),
    ],
)
def test_code_of_a_newer_service(status: int, kind: type[Exception]) -> None:
    assert type(errors.service_error({"code": "later"}, status=status)) is kind


def test_overload_is_waited_for(call: Call) -> None:
    busy = problem("overloaded", 503, "0")
    with scripted(busy, busy, CREATED) as server:
        assert call(server.url, "create", PICTURE).id == "a" * 32
    keys = {request.headers["Idempotency-Key"] for request in server.requests}
    assert len(server.requests) == 3
    assert len(keys) == 1  # so that no portrait is stored twice


def test_retry_after_is_honoured(call: Call) -> None:
    with scripted(problem("overloaded", 503, "1"), CREATED) as server:
        begin = time.monotonic()
        call(server.url, "create", PICTURE)
    assert time.monotonic() - begin > 0.9


@pytest.mark.parametrize(
    ("reply", "requests", "kind"),
    [
        (problem("overloaded", 503, "0"), 3, errors.OverloadedError),
        (problem("draining", 503), 3, errors.UnavailableError),
        (problem("overloaded", 503, "3600"), 1, errors.OverloadedError),
        (problem("idempotency_conflict", 409, "0"), 3, errors.IdempotencyError),
        (problem("idempotency_mismatch", 422), 1, errors.IdempotencyError),
        (problem("rate_limited", 429, "0"), 1, errors.RateLimitedError),
        (problem("internal", 500), 1, errors.InternalServiceError),
        (Reply(503, b"busy"), 3, errors.OverloadedError),
        (Reply(404, b"<html>"), 1, errors.UnexpectedReplyError),
        (Reply(200, b"<html>"), 1, errors.UnexpectedReplyError),
        (Reply(200, b"{}"), 1, errors.UnexpectedReplyError),
        (Reply(0), 3, errors.ConnectError),
        (Reply(-1), 3, errors.RequestTimeoutError),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_what_is_repeated_and_what_is_raised(
    call: Call, reply: Reply, requests: int, kind: type[Exception]
) -> None:
    with scripted(reply) as server, pytest.raises(kind) as raised:
        call(server.url, "create", PICTURE)
    assert len(server.requests) == requests
    assert isinstance(raised.value, errors.CVTHeadClientError)
    assert raised.value.hint


def test_delete_is_not_repeated_after_a_lost_reply(call: Call) -> None:
    with scripted(Reply(0), DELETED) as server, pytest.raises(errors.ConnectError):
        call(server.url, "delete", "a" * 32)
    assert len(server.requests) == 1
    with scripted(problem("overloaded", 503, "0"), DELETED) as server:
        call(server.url, "delete", "a" * 32)
    assert len(server.requests) == 2


def test_nobody_listens(call: Call) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(errors.ConnectError):
            call(url, "get", "x")
    with pytest.raises(errors.ConnectError):
        call("localhost:8000", "get", "x")


def test_unreadable_portrait(call: Call) -> None:
    with scripted(CREATED) as server, pytest.raises(errors.InvalidImageError):
        call(server.url, "create", "/no/such/file.png")
    assert not server.requests


def test_ids_cannot_leave_their_place_in_the_path(call: Call) -> None:
    with scripted(CREATED) as server:
        call(server.url, "get", "../x?y#z")
    assert server.requests[0].path == "/v1/avatars/..%2Fx%3Fy%23z"


def test_retry_after_is_seconds_or_a_date() -> None:
    assert retry_after("7") == 7
    assert retry_after(None) is retry_after("soon") is None
    ahead = retry_after(formatdate(time.time() + 100, usegmt=True))
    assert ahead is not None
    assert 95 < ahead <= 100
    assert retry_after(formatdate(0, usegmt=True)) == 0


def test_server_timing() -> None:
    assert timings('queue;dur=0.5, paint;desc="x";dur=20, broken;dur=x, bare') == {
        "queue": 0.5,
        "paint": 20.0,
    }
    assert timings("") == {}
