"""The application: loads the model, puts the parts together, purges and stops in order."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from importlib.metadata import version
from typing import Any

import structlog
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from cvthead.cache import AvatarCache
from cvthead.preset import load_preset
from cvthead.runtime.sessions import CPU
from service import health, middleware, models, problems
from service.engine import Engine
from service.keys import KeyRing, Tickets
from service.limits import RateLimiter
from service.metrics import CacheCollector, Metrics
from service.routers import avatars, page, render, stream, tickets, track
from service.settings import Settings
from service.signing import StillSigner
from service.state import Service
from service.warmup import warm_up

# Renders go first, also on a machine that has no core to spare.
ENCODE_NICENESS = 10
DESCRIPTION = """\
Upload a portrait, get an id, render it under any expression, pose and camera.

Every error is `application/problem+json` (RFC 9457) with a stable `code`, a `hint` and a
`request_id`. Every picture carries the IPTC mark for AI-generated media. Animate only people who
agreed.
"""
log = structlog.get_logger("cvthead")


def create_app(settings: Settings) -> FastAPI:
    """Load everything and render once; afterwards the application can answer at once.

    Raises:
        AssetError: networks are missing or altered.
        InputError: the store's folder cannot be made, or stills cannot be signed.
    """
    service = build(settings)
    app = FastAPI(
        title="cvthead",
        version=version("cvthead"),
        description=DESCRIPTION,
        docs_url="/docs" if settings.docs else None,
        redoc_url=None,
        lifespan=_lifespan,
        # Takes the place of FastAPI's own documentation of validation errors.
        responses={"default": {"description": "A problem.", "content": problems.CONTENT}},
    )
    app.state.service = service
    problems.install(app)
    middleware.install(app, settings)
    # Routes are tried in turn; what is called for every frame comes first.
    for module in (render, avatars, track, stream, tickets, page, health, models):
        app.include_router(module.router)
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


def build(settings: Settings) -> Service:
    """The parts of the service, loaded and warm, no thread or task started yet."""
    signer = _signer(settings)  # first, because it can fail at once
    pipeline = load_preset(
        settings.preset,
        model=settings.model,
        threads=settings.threads or None,
        providers=settings.providers or CPU,
        encode_niceness=ENCODE_NICENESS,
    )
    warm_up(pipeline)
    metrics = Metrics()
    metrics.build.info(
        {
            "version": version("cvthead"),
            "preset": pipeline.preset,
            "fingerprint": pipeline.fingerprint,
        }
    )
    cache = AvatarCache(
        settings.store,
        memory_bytes=settings.memory_bytes,
        lifetime=settings.lifetime_seconds,
    )
    metrics.registry.register(CacheCollector(cache))
    engine = Engine(
        pipeline,
        metrics,
        encode_queue=settings.encode_queue,
        render_queue=settings.render_queue,
        max_batch=settings.max_batch,
        encode_niceness=ENCODE_NICENESS,
    )
    return Service(
        settings,
        pipeline,
        cache,
        engine,
        metrics,
        KeyRing(settings.keys),
        Tickets(settings.ticket_seconds),
        RateLimiter(settings.rate_limit),
        signer,
    )


def _signer(settings: Settings) -> StillSigner | None:
    certificates, private_key = settings.c2pa_certificates, settings.c2pa_private_key
    if certificates is None or private_key is None:
        return None
    return StillSigner(certificates, private_key)


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    service: Service = app.state.service
    await service.engine.start()
    purge = asyncio.create_task(_purge(service))
    try:
        yield
    finally:
        service.stopping.set()
        purge.cancel()
        with suppress(asyncio.CancelledError):
            await purge
        await service.engine.stop(service.settings.drain_seconds)


async def _purge(service: Service) -> None:
    """Remove expired avatars from the store, for ever."""
    while True:
        try:
            service.metrics.stored_avatars.set(await asyncio.to_thread(_purged, service.cache))
        except OSError as error:  # the store may come back
            log.warning("purge_failed", error=error.strerror)
        await asyncio.sleep(service.settings.purge_seconds)


def _purged(cache: AvatarCache) -> int:
    """How many avatars are left."""
    cache.purge()
    return cache.count()


def _openapi(app: FastAPI) -> dict[str, Any]:
    if app.openapi_schema is None:
        schema = get_openapi(
            title=app.title,
            version=app.version,
            description=app.description,
            routes=app.routes,
        )
        body = problems.ProblemBody.model_json_schema()
        schema.setdefault("components", {}).setdefault("schemas", {})["ProblemBody"] = body
        app.openapi_schema = schema
    return app.openapi_schema
