"""Reading replies, for both clients: results, errors, and whether to try again. No I/O."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from time import time
from typing import Any, TypeVar

import httpx

from cvthead_client.calls import Call
from cvthead_client.errors import (
    ConnectError,
    CVTHeadClientError,
    RequestTimeoutError,
    ServiceError,
    TransportError,
    UnexpectedReplyError,
    service_error,
)
from cvthead_client.types import AvatarInfo, Picture, Tracked, avatar_of, tracked_of

Parsed = TypeVar("Parsed")
PROBLEM = "application/problem+json"


@dataclass(frozen=True)
class Retry:
    """When to repeat a request.

    Attributes:
        attempts: repetitions after the first try; 0 never repeats.
        longest_wait: seconds; a longer Retry-After is raised to the caller instead.
        pause: seconds before the first repetition if the service does not say; doubles then.
    """

    attempts: int = 3
    longest_wait: float = 30.0
    pause: float = 0.25


def read_avatar(response: httpx.Response) -> AvatarInfo:
    return _parsed(response, avatar_of)


def read_page(response: httpx.Response) -> tuple[list[AvatarInfo], str | None]:
    return _parsed(response, lambda d: ([avatar_of(item) for item in d["items"]], d["next"]))


def read_tracked(response: httpx.Response) -> Tracked:
    return _parsed(response, tracked_of)


def read_picture(response: httpx.Response) -> Picture:
    media_type = response.headers.get("Content-Type", "")
    if not media_type.startswith("image/"):
        raise _unexpected(f"{response.request.url} answered with {media_type or 'no type'}")
    return Picture(
        response.content,
        media_type,
        response.headers.get("X-Digital-Source-Type", ""),
        timings(response.headers.get("Server-Timing", "")),
        response.headers.get("X-Request-ID", ""),
    )


def timings(header: str) -> dict[str, float]:
    """Stage -> milliseconds of a Server-Timing header; what is malformed is left out."""
    result = {}
    for entry in header.split(","):
        name, *parameters = (part.strip() for part in entry.split(";"))
        for parameter in parameters:
            key, _, value = parameter.partition("=")
            if key == "dur" and value.replace(".", "", 1).isdecimal():
                result[name] = float(value)
    return result


def failure(response: httpx.Response) -> CVTHeadClientError:
    """The exception for a response that is not a success; its body must have been read."""
    try:
        problem = response.json()
    except (ValueError, RecursionError):
        problem = None
    if not isinstance(problem, dict):
        if response.status_code not in (429, 503):  # proxies send these without a document
            return _unexpected(
                f"{response.request.url} answered {response.status_code} without a problem document"
            )
        problem = {
            "code": "overloaded" if response.status_code == 503 else "rate_limited",
            "detail": f"{response.request.url.host} answered {response.status_code}",
            "hint": "try again later",
        }
    return service_error(
        problem,
        status=response.status_code,
        retry_after=retry_after(response.headers.get("Retry-After")),
    )


def retry_after(header: str | None) -> float | None:
    """Seconds of a Retry-After header, which holds seconds or a date (RFC 9110, 10.2.3)."""
    if header is None:
        return None
    if header.isdecimal():
        return float(header)
    try:
        date = parsedate_to_datetime(header)
    except ValueError:
        return None
    return max(0.0, date.timestamp() - time())


def transport_error(error: httpx.HTTPError, server: str) -> TransportError:
    """This package's exception for one of httpx."""
    reason = str(error) or type(error).__name__
    if isinstance(error, httpx.TimeoutException):
        return RequestTimeoutError(
            f"{server} did not answer in time ({reason})", hint="try again, or allow more time"
        )
    if isinstance(error, httpx.TransportError):
        return ConnectError(
            f"cannot reach {server}: {reason}", hint="is the service running at this address?"
        )
    return _unexpected(f"{server} sent a broken answer: {reason}")


def wait_before_retry(
    retry: Retry, call: Call, error: CVTHeadClientError, attempt: int
) -> float | None:
    """Seconds to wait before ``call`` is sent again; None if it must not be.

    Args:
        attempt: repetitions so far.
    """
    if attempt >= retry.attempts:
        return None
    # Spread, so that many clients do not come back at the same moment.
    pause: float = retry.pause * 2**attempt * random.uniform(0.75, 1.25)
    if isinstance(error, ServiceError):
        unfinished = error.code == "idempotency_conflict" and error.retry_after is not None
        if error.status != 503 and not unfinished:
            return None
        wait = pause if error.retry_after is None else error.retry_after
        return wait if wait <= retry.longest_wait else None
    if isinstance(error, UnexpectedReplyError) or not call.repeatable:
        return None
    return pause


def _unexpected(message: str) -> UnexpectedReplyError:
    return UnexpectedReplyError(message, hint="is this the address of a cvthead service?")


def _parsed(response: httpx.Response, parse: Callable[[dict[str, Any]], Parsed]) -> Parsed:
    try:
        return parse(response.json())
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _unexpected(f"{response.request.url} answered with another document") from error
