"""``POST /v1/track``: coefficients of a face, so that a client can send numbers."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from cvthead.tracking.networks import BLENDSHAPE_NAMES
from cvthead.tracking.tracker import TrackedFace
from service.answers import TrackAnswer
from service.bodies import image_body, read_upload
from service.keys import TenantDep
from service.pictures import COMMON, UPLOAD
from service.problems import responses
from service.schemas import TrackOptions
from service.state import Service, ServiceDep
from service.waiting import unless_gone

router = APIRouter(tags=["render"])


@router.post(
    "/v1/track",
    summary="Measure a face",
    response_model=TrackAnswer,
    openapi_extra=image_body(TrackOptions),
    responses=responses(*UPLOAD, "face_too_small", *COMMON),
)
async def track(
    request: Request,
    tenant: TenantDep,
    service: ServiceDep,
    options: Annotated[TrackOptions, Query()],
) -> Response:
    """A raw body or the part `image` of a multipart one. The picture is not kept."""
    service.engine.check_render()
    upload = await read_upload(request, options)

    async def tracked() -> TrackedFace:
        image = await service.engine.decode(upload.images["image"])
        return await service.engine.track(image, face=upload.options.face)

    face = await unless_gone(request, tracked())
    arkit = None
    if upload.options.blendshapes:
        arkit = await asyncio.to_thread(_blendshapes, service, face)
    answer = TrackAnswer.of(face, arkit)
    return Response(answer.model_dump_json(by_alias=True), media_type="application/json")


def _blendshapes(service: Service, face: TrackedFace) -> dict[str, float]:
    scores = service.pipeline.tracker.networks.blendshapes(face.landmarks)
    named = zip(BLENDSHAPE_NAMES, scores.tolist(), strict=True)
    return {name: round(score, 4) for name, score in named if name != "_neutral"}
