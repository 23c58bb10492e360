"""The table of all problems; ``docs/service.md`` shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """A row of the table: status, title (the same for every occurrence), when, and remedy."""

    status: int
    title: str
    meaning: str
    hint: str


PROBLEMS: Mapping[str, Kind] = {
    "malformed_request": Kind(
        400,
        "Not HTTP",
        "The request line or the headers are not HTTP/1.1, or a WebSocket's handshake is not as "
        "RFC 6455 has it.",
        "Let an HTTP library write the request.",
    ),
    "invalid_json": Kind(
        400, "Not JSON", "The body is not well-formed JSON.", "Correct the body's syntax."
    ),
    "malformed_body": Kind(
        400,
        "Body cannot be read",
        "The body is not what its Content-Type says, for example broken multipart; or its chunks "
        "are not HTTP/1.1.",
        "Let an HTTP library write the body.",
    ),
    "unauthorized": Kind(
        401,
        "No valid key",
        "The key or the ticket is missing, wrong or used up.",
        "Send `Authorization: Bearer KEY`; browsers open a stream with a ticket.",
    ),
    "forbidden": Kind(
        403,
        "Host or origin not allowed",
        "The Host header or the calling page's origin is not allowed here.",
        "Ask the operator to add it to `allowed_hosts`, `cors_origins` or `websocket_origins`.",
    ),
    "not_found": Kind(404, "No such path", "Nothing is served at this path.", "See /openapi.json."),
    "avatar_not_found": Kind(
        404,
        "No such avatar",
        "The id was never given out to this key, or the avatar was deleted.",
        "Upload the portrait.",
    ),
    "method_not_allowed": Kind(
        405,
        "Method not allowed",
        "The path does not know this method.",
        "Use one of the methods in the Allow header.",
    ),
    "not_acceptable": Kind(
        406,
        "No acceptable format",
        "None of the formats in Accept can be made.",
        "Accept image/png, image/jpeg or image/webp.",
    ),
    "request_timeout": Kind(
        408,
        "Request came too slowly",
        "The headers or the body did not arrive within `receive_seconds`.",
        "Send a smaller picture, or use a faster connection.",
    ),
    "model_changed": Kind(
        409,
        "Made with other weights",
        "The avatar was made with other trained weights than are loaded now.",
        "Upload the portrait again.",
    ),
    "idempotency_conflict": Kind(
        409,
        "The same request is being handled",
        "A request with the same Idempotency-Key has not ended yet.",
        "Retry after the time in Retry-After.",
    ),
    "avatar_expired": Kind(
        410, "The avatar has expired", "Its lifetime is over.", "Upload the portrait again."
    ),
    "invalid_avatar_file": Kind(
        410,
        "The stored avatar is damaged",
        "Its file in the store cannot be read any more.",
        "Upload the portrait again.",
    ),
    "body_too_large": Kind(
        413,
        "Body too large",
        "The body is larger than `max_body_bytes`.",
        "Send a smaller picture or fewer frames.",
    ),
    "image_too_large": Kind(
        413,
        "Picture too large",
        "The picture's header promises more pixels than are accepted; nothing was decoded.",
        "Shrink the picture.",
    ),
    "unsupported_media_type": Kind(
        415,
        "Type not supported",
        "The body is not of a type that this path takes, judged by its first bytes.",
        "Send PNG, JPEG or WebP pictures, and application/json for coefficients.",
    ),
    "invalid_request": Kind(
        422,
        "Invalid request",
        "A parameter or a field is missing, unknown, of the wrong type or out of range; "
        "`errors` lists them.",
        "Correct the fields in `errors`.",
    ),
    "invalid_image": Kind(
        422,
        "Picture cannot be used",
        "The picture is truncated, damaged or too small.",
        "Export or download the picture again.",
    ),
    "invalid_coefficients": Kind(
        422,
        "Coefficients out of range",
        "A coefficient is not finite or out of range, or a blendshape name is unknown.",
        "See /v1/models for sizes and names, /openapi.json for ranges.",
    ),
    "no_face": Kind(
        422, "No face", "The picture shows no face.", "Use a portrait seen from the front."
    ),
    "several_faces": Kind(
        422,
        "Several faces",
        "Exactly one face was asked for; `boxes` has those that were found.",
        "Choose one with `face`.",
    ),
    "face_too_small": Kind(
        422, "Face too small", "The face has too few pixels.", "Use a larger or closer picture."
    ),
    "face_turned_away": Kind(
        422,
        "Face turned away",
        "The face is covered, upside down or seen from the side.",
        "Use a portrait seen from the front.",
    ),
    "face_error": Kind(
        422, "Face cannot be used", "The face cannot be fitted.", "Use another picture."
    ),
    "consent_required": Kind(
        422,
        "Consent is missing",
        "The upload does not state that the person agreed.",
        "Ask the person; then send `consent=true`.",
    ),
    "idempotency_mismatch": Kind(
        422,
        "Idempotency-Key used for another request",
        "The same Idempotency-Key came with another body or other options before.",
        "Use a new key for a new request.",
    ),
    "rate_limited": Kind(
        429,
        "Too many requests",
        "More requests than `rate_limit` within a minute.",
        "Retry after the time in Retry-After.",
    ),
    "headers_too_large": Kind(
        431,
        "Headers too large",
        "The request line and the headers are larger than 64 KiB.",
        "Send fewer or shorter headers.",
    ),
    "internal": Kind(
        500,
        "Internal error",
        "A fault of the service; the log has it under the request id.",
        "Report it with the request id.",
    ),
    "overloaded": Kind(
        503,
        "Overloaded",
        "The queue is full; nothing was begun.",
        "Retry after the time in Retry-After.",
    ),
    "not_ready": Kind(
        503, "Not ready", "The store cannot be written.", "Check the store's folder and disk."
    ),
    "draining": Kind(
        503, "Stopping", "The service is stopping and takes no new work.", "Use another instance."
    ),
    "store_full": Kind(
        507,
        "Store full",
        "The store holds as many avatars as it may, or its disk is full.",
        "Delete avatars, or wait until some expire.",
    ),
}
