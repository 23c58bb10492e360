"""``GET /``: the page, and the files it is made of. No key is needed to load it."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter, Request
from starlette.responses import Response
from starlette.staticfiles import StaticFiles

from cvthead.sample import SAMPLE

STATIC = Path(__file__).parents[1] / "static"
# Only files of this service, no inline script or style; pictures may also come from memory.
CONTENT_SECURITY_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob:",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "require-trusted-types-for 'script'",
        "trusted-types 'none'",
    )
)
HEADERS = {
    "Cache-Control": "no-cache",  # asks by ETag each time: a new version works at once
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
}

router = APIRouter(include_in_schema=False)


@router.api_route("/", methods=["GET", "HEAD"])
async def page(request: Request) -> Response:
    """The page."""
    return await _file("index.html", request)


@router.api_route(f"/static/{SAMPLE.name}", methods=["GET", "HEAD"])
async def sample(request: Request) -> Response:
    """The sample portrait, which belongs to the core package."""
    return await _file(SAMPLE.name, request, SAMPLE.parent)


@router.api_route("/static/{name}", methods=["GET", "HEAD"])
async def static(name: str, request: Request) -> Response:
    """A script, style or picture of the page; 404 for any other name."""
    return await _file(name, request)


async def _file(name: str, request: Request, folder: Path = STATIC) -> Response:
    response = await StaticFiles(directory=folder).get_response(name, request.scope)
    response.headers.update(HEADERS)
    return response
