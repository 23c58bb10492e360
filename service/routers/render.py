"""``/v1/avatars/{id}/render`` and ``/drive``: one picture."""

from __future__ import annotations

import asyncio
import time
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from numpy.typing import NDArray

from cvthead.crop import head_crop
from cvthead.driving import drive
from cvthead.head.model import HeadModel
from cvthead.preset import AnyAvatar
from cvthead.tracking.tracker import TrackedFace
from service.bodies import Upload, image_body, json_body, read_json, read_upload
from service.engine import Pose
from service.keys import TenantDep
from service.motion import LONGEST_SIDE
from service.negotiation import image_format
from service.pictures import PICTURE, UPLOAD, output_of, picture_responses, send_frame
from service.routers import batch
from service.routers.avatars import AvatarId, load
from service.schemas import DriveOptions, RenderRequest, invalid
from service.state import Service, ServiceDep
from service.waiting import unless_gone

MAX_JSON = 2**17  # 168 numbers and 52 names
router = APIRouter(tags=["render"])
router.include_router(batch.router)


@router.post(
    "/v1/avatars/{avatar_id}/render",
    summary="Render one picture",
    response_class=Response,
    openapi_extra=json_body(RenderRequest, required=False),
    responses=picture_responses(
        *PICTURE,
        "invalid_json",
        "invalid_coefficients",
        "request_timeout",
        "body_too_large",
        "unsupported_media_type",
        description="The picture.",
    ),
)
async def render(
    request: Request, avatar_id: AvatarId, tenant: TenantDep, service: ServiceDep
) -> Response:
    """What the body leaves out keeps the portrait's value; `{}` is the portrait itself. The
    format is negotiated by `Accept`: PNG (default), JPEG or WebP."""
    kind = image_format(request)
    wanted = await read_json(request, RenderRequest, MAX_JSON)
    output = output_of(wanted.output, kind, where="body", pointer="/output")
    avatar = await load(service, tenant, avatar_id)
    return await send_frame(request, service, avatar, wanted.controls(avatar), output)


@router.post(
    "/v1/avatars/{avatar_id}/drive",
    summary="Render one picture as a driving frame shows",
    response_class=Response,
    openapi_extra=image_body(DriveOptions, "reference"),
    responses=picture_responses(
        *PICTURE, *UPLOAD, "face_too_small", "invalid_coefficients", description="The picture."
    ),
)
async def driven(
    request: Request,
    avatar_id: AvatarId,
    tenant: TenantDep,
    service: ServiceDep,
    options: Annotated[DriveOptions, Query()],
) -> Response:
    """The driving frame is a raw body or the part `image` of a multipart one; its largest face
    drives. A part `reference` is a frame in which the driver looks as the portrait does. Both are
    shrunk to 960 pixels, as the frames of a stream are. The format is negotiated by `Accept`: PNG
    (default), JPEG or WebP."""
    kind = image_format(request)
    avatar = await load(service, tenant, avatar_id)
    service.engine.check_render()
    upload = await read_upload(request, options, optional=("reference",))
    options = upload.options
    if options.relative and "reference" not in upload.images:
        raise invalid("query", "/relative", "relative motion needs a picture `reference`")
    output = output_of(options, kind)
    begin = time.perf_counter()
    face, reference = await unless_gone(request, _tracked(service, upload))
    timings = {"track": (time.perf_counter() - begin) * 1000}
    start = None if options.relative is False else reference
    seen = (reference or face) if options.camera == "driver" else None
    # Too long for the event loop, above all with a crop.
    pose = await asyncio.to_thread(_pose, service.pipeline.head, avatar, face, start, seen)
    return await send_frame(request, service, avatar, pose, output, timings)


async def _tracked(
    service: Service, upload: Upload[DriveOptions]
) -> tuple[TrackedFace, TrackedFace | None]:
    """The driving face, and the reference's, whose identity it then shares."""
    engine = service.engine
    if "reference" not in upload.images:
        return await engine.track(await _decoded(service, upload, "image")), None
    reference = await engine.track(await _decoded(service, upload, "reference"))
    image = await _decoded(service, upload, "image")
    return await engine.track(image, shape=reference.coefficients.shape), reference


async def _decoded(service: Service, upload: Upload[DriveOptions], name: str) -> NDArray[np.uint8]:
    """Small, as a stream's frames: no pixel coordinates of it are in the answer."""
    return await service.engine.decode(upload.images[name], longest=LONGEST_SIDE)


def _pose(
    head: HeadModel,
    avatar: AnyAvatar,
    face: TrackedFace,
    reference: TrackedFace | None,
    seen: TrackedFace | None,
) -> Pose:
    """What ``face`` asks for; the camera stands where it sees the head of ``seen``."""
    crop = None if seen is None else head_crop(head, seen.coefficients, seen.camera)
    return drive(head, avatar, face, reference=reference, crop=crop)
