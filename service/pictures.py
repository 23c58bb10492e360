"""A rendered picture as an answer."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from cvthead.composite import background
from cvthead.controls import Controls
from cvthead.images import ImageFormat
from cvthead.preset import AnyAvatar
from service.engine import Output, Pose, Rendered, RenderJob
from service.middleware import server_timing
from service.negotiation import IMAGE_TYPES
from service.problems import responses
from service.schemas import PictureOptions, invalid
from service.signing import signed
from service.state import Service
from service.waiting import unless_gone

# What any endpoint that needs a key can answer.
COMMON = ("unauthorized", "forbidden", "rate_limited", "internal", "draining")
AVATAR = ("avatar_not_found", "avatar_expired", "invalid_avatar_file")
PICTURE = (*AVATAR, "model_changed", "not_acceptable", "invalid_request", "overloaded")
UPLOAD = (
    "malformed_body",
    "request_timeout",
    "body_too_large",
    "image_too_large",
    "unsupported_media_type",
    "invalid_request",
    "invalid_image",
    "no_face",
    "face_turned_away",
    "face_error",
    "overloaded",
)
HEADERS: dict[str, Any] = {
    "X-Digital-Source-Type": {
        "description": "IPTC DigitalSourceType; the picture carries it as XMP too.",
        "schema": {"type": "string", "format": "uri"},
    },
    "Server-Timing": {
        "description": "Milliseconds of each stage.",
        "schema": {"type": "string"},
    },
    "Vary": {"description": "Accept", "schema": {"type": "string"}},
}


def output_of(
    options: PictureOptions, image_format: ImageFormat, *, where: str = "query", pointer: str = ""
) -> Output:
    """The engine's output.

    Args:
        where, pointer: of the options in the request, for errors.

    Raises:
        Problem: ``invalid_request`` for a transparent JPEG.
    """
    default = "white" if image_format == "jpeg" else "transparent"
    choice = options.background or default
    if choice == "transparent" and image_format == "jpeg":
        raise invalid(where, f"{pointer}/background", "JPEG cannot be transparent")
    return Output(options.size, background(choice), image_format, options.quality)


async def send_frame(
    request: Request,
    service: Service,
    avatar: AnyAvatar,
    wanted: Pose | Controls,
    output: Output,
    timings: dict[str, float] | None = None,
) -> Response:
    """Render for a client that may leave, and answer with the picture.

    Args:
        timings: milliseconds of earlier stages, for Server-Timing.
    """
    job = RenderJob(avatar, wanted, output)
    rendered = await unless_gone(request, service.engine.render(job))
    rendered = await signed(service.signer, rendered)
    return Response(
        rendered.data,
        media_type=rendered.media_type,
        headers=picture_headers(rendered, timings or {}),
    )


def picture_headers(rendered: Rendered, earlier: dict[str, float]) -> dict[str, str]:
    return {
        "X-Digital-Source-Type": str(rendered.source),
        "Server-Timing": server_timing(earlier | rendered.timings),
        "Vary": "Accept",
        "Cache-Control": "no-store",
    }


def picture_responses(*codes: str, description: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI of an answer by :func:`send_frame`, and of these problems."""
    binary = {"schema": {"type": "string", "format": "binary"}}
    success = {
        "description": description,
        "content": dict.fromkeys(IMAGE_TYPES, binary),
        "headers": HEADERS,
    }
    return {200: success} | responses(*dict.fromkeys((*codes, *COMMON)))
