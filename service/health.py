"""``/health/live``, ``/health/ready`` and ``/metrics``."""

from __future__ import annotations

import asyncio
import secrets
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Request, Response
from fastapi.security import HTTPBearer
from pydantic import BaseModel, Field

from service.keys import authenticated
from service.metrics import CONTENT_TYPE_LATEST
from service.problems import Problem, responses
from service.state import ServiceDep

router = APIRouter()


class Health(BaseModel):
    """Answer of the health checks."""

    status: Literal["live", "ready"] = Field(description="What is true.", examples=["ready"])


@router.get("/health/live", tags=["operation"], summary="Is the process answering?")
async def live() -> Health:
    return Health(status="live")


@router.get(
    "/health/ready",
    tags=["operation"],
    summary="Can it take work?",
    responses=responses("not_ready", "draining"),
)
async def ready(service: ServiceDep) -> Health:
    """Weights are loaded and a warm-up render is done before the first request is taken; this
    checks that the store can be written and that the service is not stopping."""
    if service.draining:
        raise Problem("draining", headers={"Retry-After": "1"})
    if not await asyncio.to_thread(writable, service.cache.folder):
        raise Problem("not_ready")
    return Health(status="ready")


def writable(folder: Path) -> bool:
    """Whether a file can be made in the folder (a full disk or a lost volume says no)."""
    probe = folder / f".ready-{secrets.token_hex(4)}"
    try:
        probe.write_bytes(b"ready")
        probe.unlink()
    except OSError:
        return False
    return True


@router.get(
    "/metrics",
    tags=["operation"],
    summary="Prometheus metrics",
    response_class=Response,
    responses={
        200: {"content": {"text/plain": {"schema": {"type": "string"}}}},
        **responses("unauthorized"),
    },
)
async def metrics(
    request: Request,
    service: ServiceDep,
    _: Annotated[object, Depends(HTTPBearer(auto_error=False))],
) -> Response:
    """Needs a key when keys are set, unless `metrics_public` is."""
    if not service.settings.metrics_public:
        await authenticated(request)
    return Response(service.metrics.text(), media_type=CONTENT_TYPE_LATEST)
