"""Which format the client wants (RFC 9110, section 12.5.1)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import cast

from starlette.requests import Request

from cvthead.images import ImageFormat
from service.problems import Problem

IMAGE_TYPES = ("image/png", "image/jpeg", "image/webp")
_QUALITY = re.compile(r"[01](\.\d{0,3})?")


def best_type(accept: str | None, offered: Sequence[str]) -> str:
    """The offered media type that ``accept`` likes best; the first of several it likes equally.

    Args:
        accept: the Accept header; None or empty accepts everything.
        offered: media types, the preferred ones first.

    Raises:
        Problem: ``not_acceptable``.
    """
    ranges = [_range(part) for part in (accept or "*/*").split(",") if part.strip()]
    best = max(offered, key=lambda kind: _liking(kind, ranges))
    if _liking(best, ranges) <= 0:
        raise Problem("not_acceptable", hint=f"Accept {' or '.join(offered)}.")
    return best


def image_format(request: Request) -> ImageFormat:
    """The format of a picture, PNG unless Accept prefers another.

    Raises:
        Problem: ``not_acceptable``.
    """
    kind = best_type(accept(request), IMAGE_TYPES)
    return cast(ImageFormat, kind.removeprefix("image/"))


def accept(request: Request) -> str | None:
    """The Accept header; a list may be spread over several lines."""
    return ",".join(request.headers.getlist("accept")) or None


def _range(text: str) -> tuple[str, float]:
    """A media range and its weight; a malformed weight counts as 0."""
    kind, *parameters = (part.strip().lower() for part in text.split(";"))
    weight = 1.0
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            value = value.strip()
            weight = min(1.0, float(value)) if _QUALITY.fullmatch(value) else 0.0
    return kind, weight


def _liking(kind: str, ranges: Sequence[tuple[str, float]]) -> float:
    """The weight of the most specific range that covers the type; 0 without one."""
    for wanted in (kind, f"{kind.split('/')[0]}/*", "*/*"):
        weights = [weight for name, weight in ranges if name == wanted]
        if weights:
            return max(weights)
    return 0.0
