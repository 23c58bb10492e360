"""Errors as RFC 9457 problem details, on every path of the service."""

from __future__ import annotations

import json
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import Response
from starlette.routing import Match
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketState

from cvthead.errors import CVTHeadError, SeveralFacesError
from service.problem_codes import PROBLEMS

MEDIA_TYPE = "application/problem+json"
# Their messages name files of the server, which concern its operator only.
OPERATORS = ("invalid_avatar_file", "store_full")
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")
MAX_ERRORS = 20  # listed in one answer
POLICY_VIOLATION = 1008  # RFC 6455, for a stream that is already open
# For OpenAPI; the schema is added in service/app.py.
CONTENT = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemBody"}}}
log = structlog.get_logger("cvthead")


# What the framework raises itself, by status.
_FRAMEWORK = {
    400: "malformed_body",
    404: "not_found",
    405: "method_not_allowed",
    413: "body_too_large",
    415: "unsupported_media_type",
}


class ProblemBody(BaseModel):
    """RFC 9457 problem details; some codes have further members."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="URN of the code.", examples=["urn:cvthead:problem:no_face"])
    title: str = Field(description="The same for every occurrence.", examples=["No face"])
    status: int = Field(description="The HTTP status.", ge=400, le=599, examples=[422])
    detail: str = Field(description="What is wrong this time.", examples=["no face was found"])
    instance: str = Field(description="Path of the request.", examples=["/v1/avatars"])
    code: str = Field(description="Stable name, see docs/service.md.", examples=["no_face"])
    hint: str = Field(description="What to do next.", examples=["use another picture"])
    request_id: str = Field(description="Also in the logs.", examples=["8f0e6b6c0a1d4b0f"])


class Problem(HTTPException):
    """An answer other than success. Status, title and default texts come from ``PROBLEMS``.

    Args:
        code: a key of ``PROBLEMS``.
        detail: what is wrong this time; default: the code's meaning.
        hint: what to do next; default: the code's.
        headers: of the answer, for example Retry-After.
        extra: further JSON members of the body.
    """

    # An HTTPException, because FastAPI passes only these on when they are raised while it
    # reads a body.

    def __init__(
        self,
        code: str,
        detail: str | None = None,
        *,
        hint: str | None = None,
        headers: Mapping[str, str] | None = None,
        **extra: Any,
    ) -> None:
        kind = PROBLEMS[code]
        super().__init__(kind.status, detail or kind.meaning, headers)
        self.code = code
        self.title = kind.title
        self.hint = hint or kind.hint
        self.extra = extra

    def body(self, instance: str, request_id: str) -> dict[str, Any]:
        """The JSON object of the answer."""
        return {
            "type": f"urn:cvthead:problem:{self.code}",
            "title": self.title,
            "status": self.status_code,
            "detail": self.detail,
            "instance": instance,
            "code": self.code,
            "hint": self.hint,
            "request_id": request_id,
            **self.extra,
        }

    def response(self, connection: HTTPConnection) -> Response:
        """The answer to a request, or to a WebSocket handshake."""
        connection.state.problem = self.code  # for the access log and the metrics
        request_id = getattr(connection.state, "request_id", "")
        return self.plain_response(connection.url.path, request_id, self.headers)

    def plain_response(
        self, instance: str, request_id: str, headers: Mapping[str, str] | None
    ) -> Response:
        """The answer where there is no connection to take path and request id from."""
        body = json.dumps(self.body(instance, request_id))
        return Response(body, self.status_code, headers, MEDIA_TYPE)


def retry_after(seconds: float) -> dict[str, str]:
    """The header Retry-After, in whole seconds, at least 1."""
    return {"Retry-After": str(max(1, -int(-seconds // 1)))}


def from_core(error: CVTHeadError) -> Problem:
    """The problem for an error of the core package; ``internal`` for what no client can mend."""
    if error.code not in PROBLEMS:
        log.error("internal", code=error.code, error=str(error))
        return Problem("internal")
    if error.code in OPERATORS:
        log.warning("store", code=error.code, error=str(error))
        return Problem(error.code)
    if isinstance(error, SeveralFacesError):
        return Problem(error.code, str(error), hint=error.hint, boxes=list(error.boxes))
    return Problem(error.code, str(error), hint=error.hint)


def from_validation(error: RequestValidationError, content_type: str) -> Problem:
    """Which fields are wrong and why. Never their values: these may be images or keys."""
    errors = error.errors()
    if any(e["type"] == "json_invalid" for e in errors):
        return Problem("invalid_json", f"JSON: {errors[0].get('ctx', {}).get('error', '')}".strip())
    whole_body = any(e["loc"] == ("body",) and e["type"] != "missing" for e in errors)
    if whole_body and "json" not in content_type:
        return Problem("unsupported_media_type", "the body is not application/json")
    listed = [
        {
            "in": str(e["loc"][0]),
            "pointer": "".join(f"/{_escaped(part)}" for part in e["loc"][1:]),
            "message": e["msg"],
        }
        for e in errors[:MAX_ERRORS]
    ]
    first = listed[0]
    where = f"{first['in']} {first['pointer']}".strip()
    return Problem("invalid_request", f"{where}: {first['message']}", errors=listed)


def _escaped(part: object) -> str:
    """RFC 6901; cut, because the names of unknown fields are the client's."""
    return str(part)[:100].replace("~", "~0").replace("/", "~1")


def from_http(error: HTTPException) -> Problem:
    """What the framework raises itself: unknown path or method, unreadable body."""
    if isinstance(error, Problem):
        return error
    code = _FRAMEWORK.get(error.status_code)
    if code is None:
        return Problem("internal", HTTPStatus(error.status_code).phrase)
    return Problem(code, headers=error.headers)


def methods_of(connection: HTTPConnection) -> list[str]:
    """All methods of the path. The framework names only those of the first route that has it."""
    routes = connection.app.routes
    asked = {method: {**connection.scope, "method": method} for method in METHODS}
    return [
        method
        for method, scope in asked.items()
        if any(route.matches(scope)[0] is Match.FULL for route in routes)
    ]


async def nowhere(scope: Scope, receive: Receive, send: Send) -> None:
    """Answers where no route does; the framework would refuse a WebSocket with an empty 403."""
    raise Problem("not_found")


def install(app: FastAPI) -> None:
    """Let every error be answered as a problem. Unexpected ones are the middleware's."""

    async def core(connection: HTTPConnection, error: Exception) -> Response | None:
        assert isinstance(error, CVTHeadError)
        return await _answer(connection, from_core(error))

    async def validation(connection: HTTPConnection, error: Exception) -> Response | None:
        assert isinstance(error, RequestValidationError)
        content_type = connection.headers.get("content-type", "")
        return await _answer(connection, from_validation(error, content_type))

    async def http(connection: HTTPConnection, error: Exception) -> Response | None:
        assert isinstance(error, HTTPException)
        problem = from_http(error)
        if problem.code == "method_not_allowed":
            problem.headers = {"Allow": ", ".join(methods_of(connection))}
        return await _answer(connection, problem)

    app.router.default = nowhere
    app.add_exception_handler(CVTHeadError, core)  # type: ignore[arg-type]
    app.add_exception_handler(RequestValidationError, validation)  # type: ignore[arg-type]
    app.add_exception_handler(HTTPException, http)  # type: ignore[arg-type]


async def _answer(connection: HTTPConnection, problem: Problem) -> Response | None:
    response = problem.response(connection)
    if not isinstance(connection, WebSocket):
        return response
    if connection.application_state == WebSocketState.CONNECTING:
        await connection.send_denial_response(response)
    elif connection.application_state == WebSocketState.CONNECTED:
        await connection.close(POLICY_VIOLATION, problem.code)
    return None


def responses(*codes: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries of these codes, for a route's ``responses=``."""
    result: dict[int | str, dict[str, Any]] = {}
    for code in codes:
        kind = PROBLEMS[code]
        content = {MEDIA_TYPE: {**CONTENT[MEDIA_TYPE], "examples": {}}}
        entry = result.setdefault(kind.status, {"description": "", "content": content})
        entry["description"] = f"{entry['description']} `{code}`: {kind.meaning}".strip()
        example = Problem(code).body("/v1/...", "8f0e6b6c0a1d4b0f")
        entry["content"][MEDIA_TYPE]["examples"][code] = {"value": example}
    return result
