"""Request bodies: pictures (multipart or raw) and JSON. Read only once the caller is known."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from starlette.datastructures import FormData, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from service.problems import Problem
from service.schemas import invalid

M = TypeVar("M", bound=BaseModel)

# Options are words and numbers.
MAX_FIELDS, MAX_FIELD_BYTES = 16, 4096
# Smaller JSON is parsed in less time than a thread takes to begin.
SMALL_JSON = 2**14
RAW_TYPES = ("image/png", "image/jpeg", "image/webp")


@dataclass(frozen=True)
class Upload(Generic[M]):
    """Pictures, still encoded, by the names of their parts; and the options."""

    images: Mapping[str, bytes]
    options: M


class _InMemory(MultiPartParser):
    """Keeps uploads off the disk; the body limit bounds them."""

    spool_max_size = 2**40


async def read_upload(request: Request, options: M, optional: Sequence[str] = ()) -> Upload[M]:
    """The part ``image`` of a multipart body, or the whole of any other body.

    Its declared type is not believed: decoding judges by the first bytes.

    Args:
        options: from the query; multipart fields of the same names replace them.
        optional: further picture parts that may be there.

    Raises:
        Problem: ``malformed_body``, ``invalid_request``, ``body_too_large``.
        RequestValidationError: a field is unknown or out of range.
        ClientDisconnect: the client has gone.
    """
    if request.headers.get("content-type", "").split(";")[0].strip().lower() != (
        "multipart/form-data"
    ):
        return Upload({"image": await request.body()}, options)
    parser = _InMemory(
        request.headers,
        request.stream(),
        max_files=1 + len(optional),
        max_fields=MAX_FIELDS,
        max_part_size=MAX_FIELD_BYTES,
    )
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise Problem("malformed_body", error.message) from error
    try:
        return await _from_form(form, options, optional)
    finally:
        await form.close()


async def _from_form(form: FormData, options: M, optional: Sequence[str]) -> Upload[M]:
    images: dict[str, bytes] = {}
    fields: dict[str, str] = {}
    for name, value in form.multi_items():
        if name in images or name in fields:
            raise invalid("body", f"/{name[:100]}", "is there twice")
        if isinstance(value, UploadFile):
            images[name] = await value.read()
        else:
            fields[name] = value
    if "image" not in images:
        raise invalid("body", "/image", "is missing; send the picture as a file")
    unknown = [name for name in images if name not in ("image", *optional)]
    if unknown:
        raise invalid("body", f"/{unknown[0][:100]}", "no picture of this name is used")
    given = options.model_dump(exclude_unset=True, by_alias=True)
    return Upload(images, validated(type(options), given | fields))


async def read_json(request: Request, model: type[M], max_bytes: int) -> M:
    """A JSON body; an empty body is ``{}``.

    Args:
        max_bytes: far more than any valid body has. A large one is parsed in a thread.

    Raises:
        Problem: ``unsupported_media_type``, ``body_too_large``.
        RequestValidationError: not JSON, or not as the model wants it.
        ClientDisconnect: the client has gone.
    """
    kind = request.headers.get("content-type", "").split(";")[0].strip().lower()
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > max_bytes:
            raise Problem("body_too_large", f"the body is larger than {max_bytes} bytes")
    if body and kind != "application/json" and not kind.endswith("+json"):
        raise Problem("unsupported_media_type", "the body is not application/json")
    try:
        if len(body) <= SMALL_JSON:
            return model.model_validate_json(bytes(body) or b"{}")
        return await asyncio.to_thread(model.model_validate_json, bytes(body))
    except ValidationError as error:
        raise _request_error(error) from error


def validated(model: type[M], values: Mapping[str, Any]) -> M:
    """The model of form fields.

    Raises:
        RequestValidationError
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise _request_error(error) from error


def _request_error(error: ValidationError) -> RequestValidationError:
    found = error.errors(include_url=False, include_input=False)
    return RequestValidationError([{**e, "loc": ("body", *e["loc"])} for e in found])


def image_body(options: type[BaseModel], *optional: str) -> dict[str, Any]:
    """OpenAPI of a body that :func:`read_upload` reads."""
    picture = {"type": "string", "format": "binary"}
    fields = inlined(options)["properties"]
    form = {
        "type": "object",
        "required": ["image"],
        "properties": {"image": picture, **dict.fromkeys(optional, picture), **fields},
        "additionalProperties": False,
    }
    content: dict[str, Any] = {"multipart/form-data": {"schema": form}}
    content |= {kind: {"schema": picture} for kind in RAW_TYPES}
    return {"requestBody": {"required": True, "content": content}}


def json_body(model: type[BaseModel], *, required: bool) -> dict[str, Any]:
    """OpenAPI of a body that :func:`read_json` reads."""
    content = {"application/json": {"schema": inlined(model)}}
    return {"requestBody": {"required": required, "content": content}}


def inlined(model: type[BaseModel]) -> dict[str, Any]:
    """The model's JSON schema without references, which would have to be moved in OpenAPI."""
    schema = model.model_json_schema()
    definitions = schema.pop("$defs", {})

    def resolved(node: Any) -> Any:
        if isinstance(node, list):
            return [resolved(entry) for entry in node]
        if not isinstance(node, dict):
            return node
        rest = {key: resolved(value) for key, value in node.items() if key != "$ref"}
        if "$ref" in node:
            return resolved(definitions[node["$ref"].rpartition("/")[2]]) | rest
        return rest

    result: dict[str, Any] = resolved(schema)
    return result
