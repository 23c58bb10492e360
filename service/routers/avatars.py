"""``/v1/avatars``: upload, look at, list, delete."""

from __future__ import annotations

import asyncio
import hashlib
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response

from cvthead.errors import AvatarExpiredError, AvatarFileError, AvatarNotFoundError
from cvthead.preset import AnyAvatar
from cvthead.record import AvatarRecord, Box
from service.answers import EXAMPLE_CURSOR, EXAMPLE_ID, AvatarInfo, AvatarPage, AvatarSummary
from service.bodies import image_body, read_upload
from service.idempotency import Claim, Idempotency, idempotency
from service.keys import Tenant, TenantDep
from service.negotiation import image_format
from service.pictures import (
    AVATAR,
    COMMON,
    PICTURE,
    UPLOAD,
    output_of,
    picture_responses,
    send_frame,
)
from service.problems import Problem, responses
from service.schemas import PictureOptions, PortraitOptions, invalid
from service.state import Service, ServiceDep
from service.waiting import unless_gone

router = APIRouter(tags=["avatars"])

AvatarId = Annotated[str, Path(description="From the upload.", examples=[EXAMPLE_ID])]
ETAG: dict[str, Any] = {"ETag": {"description": "Of the body.", "schema": {"type": "string"}}}
LOCATION: dict[str, Any] = {
    "Location": {"description": "Path of the avatar.", "schema": {"type": "string"}},
    "Idempotency-Replayed": {
        "description": "`true` when an earlier request with this key made the avatar.",
        "schema": {"type": "string"},
    },
}
CREATED: dict[int | str, dict[str, Any]] = {
    201: {"description": "The new avatar.", "headers": ETAG | LOCATION}
}
SHOWN: dict[int | str, dict[str, Any]] = {
    200: {"headers": ETAG},
    304: {"description": "It is as `If-None-Match` says.", "headers": ETAG},
}
MAX_PAGE = 200


@router.post(
    "/v1/avatars",
    status_code=201,
    response_model=AvatarInfo,
    summary="Upload a portrait",
    openapi_extra=image_body(PortraitOptions),
    responses=CREATED
    | responses(
        *UPLOAD,
        "several_faces",
        "face_too_small",
        "consent_required",
        "idempotency_mismatch",
        "idempotency_conflict",
        "store_full",
        *COMMON,
    ),
)
async def create(
    request: Request,
    tenant: TenantDep,
    service: ServiceDep,
    options: Annotated[PortraitOptions, Query()],
    once: Annotated[Idempotency, Depends(idempotency)],
    idempotency_key: Annotated[
        str | None,
        Header(
            min_length=1,
            max_length=255,
            description="Any unique text. A retry with the same key, picture and options within "
            "a day gives the same avatar.",
            examples=["0b4e0a3c-6d1f-4b8e-9c55-2f6f3a1f7d10"],
        ),
    ] = None,
) -> Response:
    """PNG, JPEG or WebP, as a raw body or as the part `image` of a multipart one. The picture is
    not kept. Of an animation the first frame is used."""
    service.engine.check_encode()
    upload = await read_upload(request, options)
    _check(upload.options, service)
    data = upload.images["image"]
    if idempotency_key is None:
        record, avatar = await _make(request, service, tenant, data, upload.options)
        return _described(request, record, avatar, created=True)
    fingerprint = await asyncio.to_thread(_fingerprint, data, upload.options)
    async with once.once(tenant.name, idempotency_key, fingerprint) as claim:
        earlier = await asyncio.to_thread(_earlier, service, tenant, claim)
        record, avatar = earlier or await _make(request, service, tenant, data, upload.options)
        claim.result = record.id
    response = _described(request, record, avatar, created=True)
    if earlier:
        response.headers["Idempotency-Replayed"] = "true"
    return response


@router.get(
    "/v1/avatars",
    summary="List your avatars",
    responses=responses("invalid_request", *COMMON),
)
async def listing(
    request: Request,
    tenant: TenantDep,
    service: ServiceDep,
    limit: Annotated[
        int, Query(ge=1, le=MAX_PAGE, description="Avatars per page.", examples=[20])
    ] = 50,
    cursor: Annotated[
        str | None,
        Query(description="`next` of the page before.", max_length=100, examples=[EXAMPLE_CURSOR]),
    ] = None,
) -> AvatarPage:
    """Newest first. Pages stay complete while avatars are uploaded and deleted."""
    before = None if cursor is None else _place(cursor)
    found = await asyncio.to_thread(
        service.cache.records, tenant.name, before=before, limit=limit + 1
    )
    last = found[limit - 1] if len(found) > limit else None
    return AvatarPage(
        items=[AvatarSummary.of(r, _path(request, r.id)) for r in found[:limit]],
        next=None if last is None else f"{last.created:.6f}-{last.id}",
    )


@router.get(
    "/v1/avatars/{avatar_id}",
    response_model=AvatarInfo,
    summary="Look at an avatar",
    responses=SHOWN | responses(*AVATAR, *COMMON),
)
async def show(
    request: Request,
    avatar_id: AvatarId,
    tenant: TenantDep,
    service: ServiceDep,
    if_none_match: Annotated[
        str | None, Header(description="ETags that you have.", examples=['"3f1c2b"'])
    ] = None,
) -> Response:
    record = await asyncio.to_thread(service.cache.record, avatar_id, owner=tenant.name)
    response = _described(request, record, await load(service, tenant, avatar_id))
    etags = {tag.strip().removeprefix("W/") for tag in (if_none_match or "").split(",")}
    if etags & {"*", response.headers["ETag"]}:
        return Response(status_code=304, headers={"ETag": response.headers["ETag"]})
    return response


@router.delete(
    "/v1/avatars/{avatar_id}",
    status_code=204,
    summary="Delete an avatar",
    responses=responses(*AVATAR, *COMMON),
)
async def delete(avatar_id: AvatarId, tenant: TenantDep, service: ServiceDep) -> None:
    """Gone at once from memory and disk."""
    await asyncio.to_thread(service.cache.delete, avatar_id, owner=tenant.name)


@router.get(
    "/v1/avatars/{avatar_id}/preview",
    summary="The portrait as it is rendered",
    response_class=Response,
    responses=picture_responses(*PICTURE, description="The avatar in the portrait's pose."),
)
async def preview(
    request: Request,
    avatar_id: AvatarId,
    tenant: TenantDep,
    service: ServiceDep,
    options: Annotated[PictureOptions, Query()],
) -> Response:
    """The format is negotiated by `Accept`: PNG (default), JPEG or WebP."""
    output = output_of(options, image_format(request))
    avatar = await load(service, tenant, avatar_id)
    pose = avatar.coefficients, avatar.camera
    return await send_frame(request, service, avatar, pose, output)


async def load(service: Service, tenant: Tenant, avatar_id: str) -> AnyAvatar:
    """The tenant's avatar, from memory or disk.

    Raises:
        AvatarNotFoundError, AvatarExpiredError, AvatarFileError
    """
    if service.cache.in_memory(avatar_id):  # a thread would take longer than the look-up
        return service.cache.get(avatar_id, owner=tenant.name)
    return await asyncio.to_thread(service.cache.get, avatar_id, owner=tenant.name)


def _check(options: PortraitOptions, service: Service) -> None:
    if service.settings.consent and not options.consent:
        raise Problem("consent_required")
    longest = service.settings.lifetime_max_seconds
    if options.lifetime is not None and options.lifetime > longest:
        raise invalid("query", "/lifetime", f"is longer than {longest:g} seconds")


async def _make(
    request: Request, service: Service, tenant: Tenant, data: bytes, options: PortraitOptions
) -> tuple[AvatarRecord, AnyAvatar]:
    if await asyncio.to_thread(service.cache.count) >= service.settings.store_max_avatars:
        raise Problem("store_full")

    async def encoded() -> tuple[AnyAvatar, Box]:
        image = await service.engine.decode(data)
        return await service.engine.encode(image, face=options.face, only_one=options.face is None)

    avatar, box = await unless_gone(request, encoded())
    # Not cancelled any more: a client that has gone finds the avatar by its Idempotency-Key.
    lifetime = ... if options.lifetime is None else options.lifetime
    record = await asyncio.to_thread(
        service.cache.put, avatar, owner=tenant.name, lifetime=lifetime, box=box
    )
    return record, avatar


def _earlier(
    service: Service, tenant: Tenant, claim: Claim
) -> tuple[AvatarRecord, AnyAvatar] | None:
    """What an earlier request with the same key made, if it is still there."""
    if claim.result is None:
        return None
    try:
        record = service.cache.record(claim.result, owner=tenant.name)
        return record, service.cache.get(claim.result, owner=tenant.name)
    except (AvatarNotFoundError, AvatarExpiredError, AvatarFileError):
        return None


def _fingerprint(data: bytes, options: PortraitOptions) -> str:
    return hashlib.sha256(options.model_dump_json().encode() + b"\0" + data).hexdigest()


def _described(
    request: Request, record: AvatarRecord, avatar: AnyAvatar, *, created: bool = False
) -> Response:
    path = _path(request, record.id)
    body = AvatarInfo.about(record, path, avatar).model_dump_json(by_alias=True).encode()
    headers = {"ETag": f'"{hashlib.sha256(body).hexdigest()[:32]}"'}
    if created:
        headers["Location"] = path
    status = 201 if created else 200
    return Response(body, status, headers, "application/json")


def _path(request: Request, avatar_id: str) -> str:
    return f"{request.scope.get('root_path', '')}/v1/avatars/{avatar_id}"


def _place(cursor: str) -> tuple[float, str]:
    created, _, avatar_id = cursor.partition("-")
    try:
        return float(created), avatar_id
    except ValueError:
        raise invalid("query", "/cursor", "is not `next` of a page") from None
