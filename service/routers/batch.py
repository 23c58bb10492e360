"""``/v1/avatars/{id}/batch``: many pictures of one avatar, streamed as they are made."""

from __future__ import annotations

import asyncio
from contextlib import aclosing
from typing import Any

from fastapi import APIRouter, Request, Response
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from cvthead.controls import resolve
from cvthead.head.arkit import ArkitMap
from cvthead.preset import AnyAvatar
from cvthead.provenance import SourceType
from service.bodies import json_body, read_json
from service.containers import MULTIPART_TYPE, PARTS, VIDEO_TYPE, Frames, Parts, video
from service.engine import Output, Pose, RenderJob
from service.frames import rendered_in_order
from service.keys import TenantDep
from service.negotiation import accept, best_type
from service.pictures import COMMON, HEADERS, PICTURE, output_of
from service.problems import responses
from service.routers.avatars import AvatarId, load
from service.schemas import BatchRequest, checked_controls, invalid
from service.signing import all_signed
from service.state import ServiceDep
from service.waiting import unless_gone

MAX_JSON = 2**23  # 1000 frames of 168 numbers
router = APIRouter()
BINARY = {"schema": {"type": "string", "format": "binary"}}
STREAMED: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The frames as they are made: parts of multipart/mixed, files of a zip; "
        "or an MP4 once it is complete.",
        "content": dict.fromkeys((*PARTS, VIDEO_TYPE), BINARY),
        "headers": {name: HEADERS[name] for name in ("X-Digital-Source-Type", "Vary")},
    }
}


class Streamed(StreamingResponse):
    """Ends its source as soon as the client has gone, and not when it is collected."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async with aclosing(self.body_iterator):  # type: ignore[type-var]
            await super().__call__(scope, receive, send)


@router.post(
    "/v1/avatars/{avatar_id}/batch",
    summary="Render many pictures",
    response_class=Response,
    openapi_extra=json_body(BatchRequest, required=True),
    responses=STREAMED
    | responses(
        *PICTURE,
        "invalid_json",
        "invalid_coefficients",
        "request_timeout",
        "body_too_large",
        "unsupported_media_type",
        *COMMON,
    ),
)
async def batch(
    request: Request, avatar_id: AvatarId, tenant: TenantDep, service: ServiceDep
) -> Response:
    """`Accept` chooses multipart/mixed (default), application/zip or video/mp4. Rendering stops
    when the client leaves. Frames wait for room in the queue behind the first one."""
    kind = best_type(accept(request), (MULTIPART_TYPE, "application/zip", VIDEO_TYPE))
    wanted = await read_json(request, BatchRequest, MAX_JSON)
    avatar = await load(service, tenant, avatar_id)
    output = _output(wanted, kind)
    poses = await asyncio.to_thread(_poses, wanted, avatar, service.pipeline.arkit)
    jobs = [RenderJob(avatar, pose, output) for pose in poses]
    frames = rendered_in_order(service.engine, jobs)
    source = SourceType.COMPOSITE if output.background == "source" else SourceType.GENERATED
    headers = {
        "X-Digital-Source-Type": str(source),
        "Vary": "Accept",
        "Cache-Control": "no-store",
    }
    if kind == VIDEO_TYPE:
        file = await unless_gone(request, video(frames, output.size, wanted.fps, source))
        return Streamed(file.chunks(), headers=headers, media_type=VIDEO_TYPE)
    parts: Parts = PARTS[kind]()
    started = await unless_gone(request, _started(all_signed(service.signer, frames)))
    return Streamed(parts.stream(started), headers=headers, media_type=parts.media_type)


def _output(wanted: BatchRequest, kind: str) -> Output:
    """Of every frame. A video has no alpha, and is made of uncompressed frames."""
    if kind != VIDEO_TYPE:
        return output_of(wanted.output, wanted.output.format, where="body", pointer="/output")
    if wanted.output.background == "transparent":
        raise invalid("body", "/output/background", "MP4 cannot be transparent")
    # As for JPEG: on white unless the request says otherwise.
    opaque = output_of(wanted.output, "jpeg")
    return Output(opaque.size, opaque.background, "raw", opaque.quality)


def _poses(wanted: BatchRequest, avatar: AnyAvatar, arkit: ArkitMap) -> list[Pose]:
    """All at once, so that a mistake in the last frame is found before the first is sent."""
    controls = [checked_controls(f, avatar, f"frames/{i}") for i, f in enumerate(wanted.frames)]
    return [resolve(avatar.coefficients, avatar.camera, c, arkit) for c in controls]


async def _started(frames: Frames) -> Frames:
    """The same frames once the first is there, while an error can still be answered."""
    first = await anext(frames)

    async def all_of_them() -> Frames:
        async with aclosing(frames):
            yield first
            async for frame in frames:
                yield frame

    return all_of_them()
