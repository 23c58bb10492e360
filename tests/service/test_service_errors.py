"""Errors of every origin are problems; the middleware around a few small routes."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, cast

import httpx
import pytest
import structlog
from fastapi import FastAPI, Request, WebSocket
from pydantic import BaseModel, Field
from starlette.requests import ClientDisconnect
from starlette.types import Message

from cvthead import errors
from cvthead.cache import AvatarCache
from service import middleware, problems
from service.keys import KeyRing, TenantDep, Tickets
from service.limits import RateLimiter
from service.metrics import Metrics
from service.problem_codes import PROBLEMS
from service.problems import Problem
from service.settings import Settings
from service.state import Service

MEMBERS = {"type", "title", "status", "detail", "instance", "code", "hint", "request_id"}
KEY = "0123456789abcdef"
CORE = [
    errors.ImageError,
    errors.ImageTypeError,
    errors.ImageTooLargeError,
    errors.CoefficientsError,
    errors.NoFaceError,
    errors.FaceTooSmallError,
    errors.FaceTurnedError,
    errors.AvatarFileError,
    errors.ModelChangedError,
    errors.AvatarNotFoundError,
    errors.AvatarExpiredError,
    errors.StoreError,
]


class Numbers(BaseModel, extra="forbid"):
    values: list[float] = Field(max_length=3)


def small_app(tmp_path: Path, **settings: Any) -> FastAPI:
    """The service's middleware and error handling around routes that need no model."""
    chosen = Settings(allowed_hosts=("test", "*.example.com"), **settings)
    app = FastAPI(openapi_url=None)
    nothing = cast(Any, None)  # these routes render nothing
    app.state.service = Service(
        chosen,
        nothing,
        AvatarCache(tmp_path),
        nothing,
        Metrics(),
        KeyRing(chosen.keys),
        Tickets(30),
        RateLimiter(chosen.rate_limit),
    )
    problems.install(app)
    middleware.install(app, chosen)

    @app.post("/v1/fail")
    async def fail() -> None:
        raise RuntimeError("broken")

    @app.post("/v1/gone")
    async def gone() -> None:
        raise ClientDisconnect

    @app.post("/v1/core/{name}")
    async def core(name: str) -> None:
        if name == "SeveralFacesError":
            raise errors.SeveralFacesError("two", hint="choose", boxes=[(1, 2, 3, 4)])
        raise getattr(errors, name)("/secret/path is wrong", hint="mend it")

    @app.post("/v1/numbers/{count}")
    async def numbers(count: int, body: Numbers) -> int:
        return count

    @app.post("/v1/raw")
    async def raw(request: Request) -> int:
        return len(await request.body())

    @app.post("/v1/form")
    async def form(request: Request) -> int:
        return len(await request.form())

    @app.get("/v1/mine")
    async def mine(tenant: TenantDep) -> str:
        return tenant.name

    @app.websocket("/v1/stream")
    async def stream(websocket: WebSocket, accept: bool = False) -> None:
        if accept:
            await websocket.accept()
        raise Problem("avatar_expired")

    return app


def calls(app: FastAPI, *requests: tuple[str, str, dict[str, Any]]) -> list[httpx.Response]:
    """The answers to some requests, one after the other."""

    async def run() -> list[httpx.Response]:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://test") as client:
            return [await client.request(method, url, **more) for method, url, more in requests]

    return asyncio.run(run())


def call(app: FastAPI, method: str, url: str, **more: Any) -> httpx.Response:
    return calls(app, (method, url, more))[0]


def problem(answer: httpx.Response, code: str) -> dict[str, Any]:
    """The body, after a check of all that every problem has in common."""
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    body: dict[str, Any] = answer.json()
    kind = PROBLEMS[code]
    assert body["code"] == code
    assert set(body) >= MEMBERS
    assert all(body[member] for member in MEMBERS)
    assert body["type"] == f"urn:cvthead:problem:{code}"
    assert (body["status"], body["title"]) == (answer.status_code, kind.title)
    assert answer.status_code == kind.status
    assert body["request_id"] == answer.headers["x-request-id"]
    assert body["instance"] == answer.request.url.path
    return body


@pytest.mark.parametrize("error", CORE)
def test_errors_of_the_core(error: type[errors.CVTHeadError], tmp_path: Path) -> None:
    app = small_app(tmp_path)
    body = problem(call(app, "POST", f"/v1/core/{error.__name__}"), error.code)
    if error in (errors.AvatarFileError, errors.StoreError):
        assert "/secret" not in json.dumps(body), "the server's folders are nobody's business"
    else:
        assert (body["detail"], body["hint"]) == ("/secret/path is wrong", "mend it")


def test_several_faces_come_with_their_boxes(tmp_path: Path) -> None:
    answer = call(small_app(tmp_path), "POST", "/v1/core/SeveralFacesError")
    assert problem(answer, "several_faces")["boxes"] == [[1, 2, 3, 4]]


@pytest.mark.parametrize("name", ["AssetError", "VideoError", "InputError"])
def test_errors_that_no_client_can_mend_tell_nothing(name: str, tmp_path: Path) -> None:
    answer = call(small_app(tmp_path), "POST", f"/v1/core/{name}")
    assert "secret" not in json.dumps(problem(answer, "internal"))


def test_an_unexpected_error_is_internal_and_logged(tmp_path: Path) -> None:
    with structlog.testing.capture_logs() as lines:
        answer = call(small_app(tmp_path), "POST", "/v1/fail")
    assert "broken" not in json.dumps(problem(answer, "internal"))
    assert [line["event"] for line in lines] == ["internal", "request"]
    assert lines[0]["exc_info"]
    assert lines[1]["status"] == 500


def test_a_client_that_went_is_no_error(tmp_path: Path) -> None:
    app = small_app(tmp_path)
    httpx_wants_an_answer = pytest.raises(AssertionError)
    with structlog.testing.capture_logs() as lines, httpx_wants_an_answer:
        call(app, "POST", "/v1/gone")
    assert [(line["event"], line["status"]) for line in lines] == [("request", 499)]
    assert app.state.service.in_flight == 0


def test_unknown_paths_and_methods(tmp_path: Path) -> None:
    app = small_app(tmp_path)
    problem(call(app, "GET", "/v1/nothing"), "not_found")
    answer = call(app, "GET", "/v1/raw")
    problem(answer, "method_not_allowed")
    assert answer.headers["allow"] == "POST"


@pytest.mark.parametrize(
    ("path", "body", "pointers"),
    [
        ("/v1/numbers/x", {"values": []}, ["/count"]),
        ("/v1/numbers/1", {}, ["/values"]),
        ("/v1/numbers/1", {"values": [1, "secret", {}]}, ["/values/1", "/values/2"]),
        ("/v1/numbers/1", {"values": [1, 2, 3, 4]}, ["/values"]),
        ("/v1/numbers/1", {"values": [], "a/b~c": 1}, ["/a~1b~0c"]),
        ("/v1/numbers/1", [1], [""]),
        ("/v1/numbers/1", None, [""]),
    ],
)
def test_validation(path: str, body: object, pointers: list[str], tmp_path: Path) -> None:
    answer = call(small_app(tmp_path), "POST", path, json=body)
    found = problem(answer, "invalid_request")
    assert [error["pointer"] for error in found["errors"]] == pointers
    assert all(error["message"] and error["in"] in ("body", "path") for error in found["errors"])
    assert "secret" not in answer.text, "values are not repeated"


def test_the_list_of_errors_is_bounded(tmp_path: Path) -> None:
    body = {"values": [], **{f"{'x' * 1000}{i}": 1 for i in range(1000)}}
    answer = call(small_app(tmp_path), "POST", "/v1/numbers/1", json=body)
    assert len(problem(answer, "invalid_request")["errors"]) == 20
    assert len(answer.content) < 10_000


@pytest.mark.parametrize(
    ("content", "media_type", "code"),
    [
        (b"{'values': []}", "application/json", "invalid_json"),
        (b"", "application/json", "invalid_request"),
        (b"\xff\xfe{", "application/json", "malformed_body"),
        (b"[" * 100_000, "application/json", "malformed_body"),
        (b'{"values": [1' + b"0" * 10_000 + b"]}", "application/json", "malformed_body"),
        (b'{"values": []}', "text/plain", "unsupported_media_type"),
        (b"\x89PNG", "image/png", "unsupported_media_type"),
    ],
)
def test_unreadable_json(content: bytes, media_type: str, code: str, tmp_path: Path) -> None:
    app = small_app(tmp_path)
    headers = {"content-type": media_type}
    problem(call(app, "POST", "/v1/numbers/1", content=content, headers=headers), code)


def test_broken_multipart(tmp_path: Path) -> None:
    headers = {"content-type": "multipart/form-data; boundary=x"}
    answer = call(small_app(tmp_path), "POST", "/v1/form", content=b"--y\r\n\r\n", headers=headers)
    problem(answer, "malformed_body")


def test_a_declared_body_is_refused_before_it_is_read(tmp_path: Path) -> None:
    app = small_app(tmp_path, max_body_bytes=1024)
    for length in ("1025", "9" * 5000):
        headers = {"content-length": length}
        answer = call(app, "POST", "/v1/raw", content=b"", headers=headers)
        problem(answer, "body_too_large")
    assert call(app, "POST", "/v1/raw", content=bytes(1024)).json() == 1024


@pytest.mark.parametrize(
    ("path", "media_type", "start"),
    [
        ("/v1/raw", "image/png", b""),
        ("/v1/numbers/1", "application/json", b"["),
        (
            "/v1/form",
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="image"; filename="a"\r\n\r\n',
        ),
    ],
)
def test_a_chunked_body_is_refused_while_it_arrives(
    path: str, media_type: str, start: bytes, tmp_path: Path
) -> None:
    sent = 0

    async def chunks() -> AsyncIterator[bytes]:
        nonlocal sent
        yield start
        for _ in range(1000):
            sent += 100
            yield b" " * 100

    app = small_app(tmp_path, max_body_bytes=1024)
    headers = {"content-type": media_type}
    answer = call(app, "POST", path, content=chunks(), headers=headers)
    problem(answer, "body_too_large")
    assert sent <= 1100


def test_hosts(tmp_path: Path) -> None:
    app = small_app(tmp_path)
    for host in ("test", "TEST:8000", "a.example.com", "b.a.example.com:1"):
        assert call(app, "POST", "/v1/raw", headers={"host": host}).status_code == 200
    for host in ("evil.example", "example.com", "testing", "atest", "", "[::1]"):
        problem(call(app, "POST", "/v1/raw", headers={"host": host}), "forbidden")


def test_foreign_pages_cannot_act_on_an_open_service(tmp_path: Path) -> None:
    app = small_app(tmp_path, cors_origins=("https://friend.example",))
    for origin in ("http://test", "https://friend.example"):
        assert call(app, "POST", "/v1/raw", headers={"origin": origin}).status_code == 200
    for origin in ("https://evil.example", "null", "http://test.evil.example"):
        problem(call(app, "POST", "/v1/raw", headers={"origin": origin}), "forbidden")


def test_cors(tmp_path: Path) -> None:
    app = small_app(tmp_path, cors_origins=("https://friend.example",), keys=(f"a:{KEY}",))
    asked = {"access-control-request-method": "POST"}
    friend, foe = {"origin": "https://friend.example"}, {"origin": "https://foe.example"}
    answer = call(app, "OPTIONS", "/v1/raw", headers=asked | friend)
    assert answer.status_code == 200
    assert answer.headers["access-control-allow-origin"] == "https://friend.example"
    refused = call(app, "OPTIONS", "/v1/raw", headers=asked | foe)
    assert refused.json()["code"] == "forbidden"
    assert "access-control-allow-origin" not in refused.headers
    # A page can read errors too, whatever made them.
    for path, status in (("/v1/raw", 200), ("/v1/fail", 500), ("/v1/nothing", 404)):
        answer = call(app, "POST", path, headers=friend)
        assert answer.status_code == status
        assert answer.headers["access-control-allow-origin"] == "https://friend.example"
    assert "access-control-allow-origin" not in call(app, "POST", "/v1/raw", headers=foe).headers


def test_keys(tmp_path: Path) -> None:
    app = small_app(tmp_path, keys=(f"alice:{KEY}", "bob:fedcba9876543210"))
    for value, name in ((f"Bearer {KEY}", "alice"), ("bearer  fedcba9876543210", "bob")):
        answer = call(app, "GET", "/v1/mine", headers={"authorization": value})
        assert answer.json() == name
    for value in ("", "Bearer", "Bearer x", f"Basic {KEY}", KEY, f"Bearer alice:{KEY}"):
        answer = call(app, "GET", "/v1/mine", headers={"authorization": value})
        problem(answer, "unauthorized")
        assert answer.headers["www-authenticate"] == "Bearer"


def test_rate_limit(tmp_path: Path) -> None:
    app = small_app(tmp_path, keys=(f"alice:{KEY}", "bob:fedcba9876543210"), rate_limit=3)
    alice = ("GET", "/v1/mine", {"headers": {"authorization": f"Bearer {KEY}"}})
    bob = ("GET", "/v1/mine", {"headers": {"authorization": "Bearer fedcba9876543210"}})
    guess = ("GET", "/v1/mine", {"headers": {"authorization": "Bearer x"}})
    answers = calls(app, *[alice] * 4, bob, *[guess] * 4)
    codes = [answer.status_code for answer in answers]
    assert codes == [200, 200, 200, 429, 200, 401, 401, 401, 429]
    problem(answers[3], "rate_limited")
    assert 1 <= int(answers[3].headers["retry-after"]) <= 80


def test_while_stopping_only_health_and_metrics_answer(tmp_path: Path) -> None:
    app = small_app(tmp_path)
    app.state.service.stopping = asyncio.Event()
    app.state.service.stopping.set()
    answer = call(app, "POST", "/v1/raw")
    problem(answer, "draining")
    assert answer.headers["retry-after"] == "1"
    assert answer.headers["connection"] == "close"
    problem(call(app, "GET", "/health/ready"), "not_found")  # let through to this app's routes


def test_request_ids(tmp_path: Path) -> None:
    app = small_app(tmp_path)
    given = call(app, "POST", "/v1/raw", headers={"x-request-id": "my-id.1"})
    assert given.headers["x-request-id"] == "my-id.1"
    made = {
        call(app, "POST", "/v1/raw", headers={"x-request-id": wrong}).headers["x-request-id"]
        for wrong in ("", "a b", "x" * 65, 'a","b":"')
    }
    assert len(made) == 4
    assert all(len(identifier) == 16 for identifier in made)


def test_security_headers_and_no_caching(tmp_path: Path) -> None:
    headers = call(small_app(tmp_path), "POST", "/v1/raw").headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["content-security-policy"].startswith("default-src 'none'")
    assert headers["cache-control"] == "no-store"


def test_metrics_and_log_lines_name_no_path(tmp_path: Path) -> None:
    app = small_app(tmp_path)
    with structlog.testing.capture_logs() as lines:
        call(app, "POST", "/v1/core/NoFaceError?ticket=sesame")
        call(app, "POST", "/v1/raw", content=b"the picture")
        call(app, "INVENTED", "/v1/raw")
        call(app, "GET", "/v1/secret-place")
    text = app.state.service.metrics.text().decode() + str(lines)
    assert [line["status"] for line in lines] == [422, 200, 405, 404]
    for route in ("/v1/core/{name}", "/v1/raw", "unmatched"):
        assert f'route="{route}"' in text
    assert 'problems_total{code="no_face"} 1.0' in text
    assert 'method="OTHER"' in text
    for secret in ("NoFaceError", "sesame", "the picture", "INVENTED", "secret-place"):
        assert secret not in text


@pytest.mark.parametrize("accept", [False, True])
def test_problems_of_a_stream(accept: bool, tmp_path: Path) -> None:
    sent: list[Message] = []
    scope = {
        "type": "websocket",
        "path": "/v1/stream",
        "raw_path": b"/v1/stream",
        "query_string": f"accept={accept}".encode(),
        "headers": [(b"host", b"test")],
        "scheme": "ws",
        "server": ("test", 80),
        "client": ("test", 1),
        "subprotocols": [],
        "extensions": {"websocket.http.response": {}},
    }

    async def receive() -> Message:
        return {"type": "websocket.connect"}

    async def send(message: Message) -> None:
        sent.append(message)

    asyncio.run(small_app(tmp_path)(scope, receive, send))
    if accept:
        assert (sent[-1]["type"], sent[-1]["code"]) == ("websocket.close", 1008)
        assert sent[-1]["reason"] == "avatar_expired"
    else:
        assert (sent[0]["type"], sent[0]["status"]) == ("websocket.http.response.start", 410)
        assert json.loads(sent[1]["body"])["code"] == "avatar_expired"


def test_documented_answers_are_problems() -> None:
    found = problems.responses("no_face", "several_faces", "overloaded")
    assert set(found) == {422, 503}
    examples = found[422]["content"]["application/problem+json"]["examples"]
    assert set(examples) == {"no_face", "several_faces"}
    assert all(set(e["value"]) >= MEMBERS for e in examples.values())


def test_the_core_has_no_code_unknown_to_the_table() -> None:
    classes = [c for c in vars(errors).values() if isinstance(c, type)]
    codes = {c.code for c in classes if issubclass(c, errors.CVTHeadError)}
    # Base classes, and what only the command line or a broken installation raises.
    ours = {"error", "invalid_input", "invalid_video", "avatar_error", "asset_error"}
    assert codes - set(PROBLEMS) == ours
