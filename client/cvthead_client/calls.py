"""Building requests, for both clients. No I/O but reading picture files."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, urlsplit

import httpx

from cvthead_client.errors import ConnectError, InvalidImageError
from cvthead_client.types import Controls, Output, PictureFormat, Portrait
from cvthead_client.wire import Codec, sniff

_MEDIA_TYPES = {Codec.JPEG: "image/jpeg", Codec.PNG: "image/png", Codec.WEBP: "image/webp"}


@dataclass(frozen=True)
class Call:
    """One request. ``repeatable``: may be sent again when it is unknown whether it arrived."""

    method: str
    path: str
    params: Mapping[str, str] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    content: bytes | None = None
    files: Mapping[str, tuple[str, bytes, str]] | None = None
    repeatable: bool = True

    def request(self, http: httpx.Client | httpx.AsyncClient) -> httpx.Request:
        return http.build_request(
            self.method,
            self.path,
            params=self.params,
            headers=self.headers,
            content=self.content,
            files=self.files,
        )


def server_url(server: str) -> str:
    """The service's address without a trailing slash.

    Raises:
        ConnectError: not an http or https address.
    """
    parts = urlsplit(server)
    if parts.scheme not in ("http", "https") or not parts.netloc:
        raise ConnectError(f"{server!r} is not an address", hint="use http://host:port")
    return server.rstrip("/")


def headers_for(key: str | None) -> dict[str, str]:
    headers = {"User-Agent": "cvthead-client"}
    return headers if key is None else headers | {"Authorization": f"Bearer {key}"}


def create(
    portrait: Portrait,
    *,
    face: int | None,
    lifetime: float | None,
    consent: bool,
    idempotency_key: str | None,
) -> Call:
    params = {}
    if face is not None:
        params["face"] = str(face)
    if lifetime is not None:
        params["lifetime"] = f"{lifetime:g}"
    if consent:
        params["consent"] = "true"
    data, media_type = _picture(portrait)
    headers = {"Content-Type": media_type, "Idempotency-Key": idempotency_key or str(uuid.uuid4())}
    return Call("POST", "/v1/avatars", params, headers, data)


def get(avatar_id: str) -> Call:
    return Call("GET", _avatar(avatar_id))


def page(limit: int, cursor: str | None) -> Call:
    params = {"limit": str(limit)} | ({} if cursor is None else {"cursor": cursor})
    return Call("GET", "/v1/avatars", params)


def delete(avatar_id: str) -> Call:
    # Sent twice, the second would report that the avatar does not exist.
    return Call("DELETE", _avatar(avatar_id), repeatable=False)


def preview(avatar_id: str, picture_format: PictureFormat) -> Call:
    return Call("GET", _avatar(avatar_id, "/preview"), headers=_accept(picture_format))


def render(
    avatar_id: str, controls: Controls, output: Output, picture_format: PictureFormat
) -> Call:
    document = _controls(controls) | _given(output=_output(output) or None)
    return _post_json(_avatar(avatar_id, "/render"), document, _accept(picture_format))


def drive(
    avatar_id: str,
    picture: Portrait,
    *,
    reference: Portrait | None,
    camera: Literal["source", "driver"],
    output: Output,
    picture_format: PictureFormat,
) -> Call:
    params = {name: str(value) for name, value in _output(output).items()} | {"camera": camera}
    path, accept = _avatar(avatar_id, "/drive"), _accept(picture_format)
    data, media_type = _picture(picture)
    if reference is None:
        return Call("POST", path, params, accept | {"Content-Type": media_type}, data)
    files = {"image": ("image", data, media_type), "reference": ("reference", *_picture(reference))}
    return Call("POST", path, params, accept, files=files)


def track(picture: Portrait, *, face: int | None, blendshapes: bool) -> Call:
    params = {"blendshapes": "true" if blendshapes else "false"}
    if face is not None:
        params["face"] = str(face)
    data, media_type = _picture(picture)
    return Call("POST", "/v1/track", params, {"Content-Type": media_type}, data)


def batch(
    avatar_id: str,
    frames: Iterable[Controls],
    fps: float,
    output: Output,
    picture_format: PictureFormat,
    accept: str,
) -> Call:
    document = {
        "frames": [_controls(frame) for frame in frames],
        "fps": fps,
        "output": _output(output) | {"format": picture_format},
    }
    return _post_json(_avatar(avatar_id, "/batch"), document, {"Accept": accept})


def _picture(picture: Portrait) -> tuple[bytes, str]:
    if isinstance(picture, bytes):
        data = picture
    else:
        try:
            data = Path(picture).read_bytes()
        except OSError as error:
            raise InvalidImageError(
                f"cannot read {picture}: {error.strerror}", hint="check the path"
            ) from error
    # Of another type the service says which one it is.
    return data, _MEDIA_TYPES.get(sniff(data), "application/octet-stream")


def _avatar(avatar_id: str, rest: str = "") -> str:
    return f"/v1/avatars/{quote(avatar_id, safe='')}{rest}"


def _accept(picture_format: PictureFormat) -> dict[str, str]:
    return {"Accept": f"image/{picture_format}"}


def _post_json(path: str, document: dict[str, Any], headers: dict[str, str]) -> Call:
    content = json.dumps(document).encode()
    return Call("POST", path, {}, headers | {"Content-Type": "application/json"}, content)


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _output(output: Output) -> dict[str, Any]:
    return _given(**asdict(output))


def _controls(controls: Controls) -> dict[str, Any]:
    pose = {
        "global": controls.global_rotation,
        "neck": controls.neck,
        "jaw": controls.jaw,
        "left_eye": controls.left_eye,
        "right_eye": controls.right_eye,
    }
    rotations = {joint: _floats(value) for joint, value in pose.items() if value is not None}
    return {"mode": controls.mode} | _given(
        shape=None if controls.shape is None else _floats(controls.shape),
        expression=None if controls.expression is None else _floats(controls.expression),
        pose=rotations or None,
        camera=None if controls.camera is None else asdict(controls.camera),
        arkit=None if controls.arkit is None else dict(controls.arkit),
    )


def _floats(values: Sequence[float]) -> list[float]:
    # NumPy's scalars are no JSON.
    return [float(value) for value in values]
