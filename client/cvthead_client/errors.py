"""Every error a caller can act on, in one hierarchy.

    CVTHeadClientError
    |-- TransportError                no usable answer came back
    |   |-- ConnectError              nobody listens at this address
    |   |-- RequestTimeoutError       no answer in time
    |   `-- UnexpectedReplyError      an answer that no cvthead service gives
    |-- WireError                     a stream message that breaks the protocol
    |-- StreamClosedError             the stream ended without a reason that has a class below
    `-- ServiceError                  the service refused and said why
        |-- InvalidRequestError       change the request; ``errors`` lists the fields
        |   `-- InvalidCoefficientsError  wrong length, NaN, out of range, unknown ARKit name
        |-- PictureError              send another picture
        |   |-- InvalidImageError     damaged, or not PNG, JPEG or WebP
        |   |-- TooLargeError         too many bytes or pixels
        |   `-- FaceError
        |       |-- NoFaceError
        |       |-- SeveralFacesError     choose one; carries the boxes
        |       |-- FaceTooSmallError
        |       `-- FaceTurnedError       profile or covered
        |-- ConsentRequiredError      state that the person agreed
        |-- UnauthorizedError         the key or ticket is missing or wrong
        |-- ForbiddenError            this origin or host is not allowed
        |-- AvatarError               upload the portrait again
        |   |-- AvatarNotFoundError   unknown, deleted, or another key's
        |   |-- AvatarExpiredError    its lifetime is over, or its file is damaged
        |   `-- ModelChangedError     made with weights that were replaced since
        |-- IdempotencyError          the Idempotency-Key belongs to another request
        |-- RetryLaterError           the same request will work later; ``retry_after``
        |   |-- RateLimitedError      this key asked too often
        |   |-- OverloadedError       the queues are full
        |   `-- UnavailableError      starting or stopping
        |-- StoreFullError            delete avatars first
        `-- InternalServiceError      a fault of the service; quote ``request_id``

The message says what is wrong; ``hint`` says what to do next; ``code`` is stable.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class CVTHeadClientError(Exception):
    """Base of all errors raised on purpose by this package."""

    def __init__(self, message: str, *, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


class TransportError(CVTHeadClientError):
    """No usable answer came back."""


class ConnectError(TransportError):
    pass


class RequestTimeoutError(TransportError):
    pass


class UnexpectedReplyError(TransportError):
    pass


class WireError(CVTHeadClientError):
    """A stream message that breaks the protocol. ``code`` is what the service answers."""

    def __init__(
        self,
        message: str,
        *,
        hint: str = "see docs/streaming.md for the protocol",
        code: str = "protocol_error",
    ) -> None:
        super().__init__(message, hint=hint)
        self.code = code


class StreamClosedError(CVTHeadClientError):
    """The stream ended. ``close_code``: of the WebSocket, RFC 6455 section 7.4."""

    def __init__(self, message: str, *, hint: str, close_code: int) -> None:
        super().__init__(message, hint=hint)
        self.close_code = close_code


class ServiceError(CVTHeadClientError):
    """The service refused (RFC 9457 problem details).

    Attributes:
        code: stable name of the problem, listed in docs/service.md.
        status: HTTP status; 0 when the problem came over a stream.
        hint: what to do next.
        request_id: identifies the request in the service's logs; "" if unknown.
        retry_after: seconds to wait before the same request, None if not said.
        problem: the whole problem document.
    """

    def __init__(
        self,
        message: str,
        *,
        hint: str = "",
        code: str = "",
        status: int = 0,
        retry_after: float | None = None,
        problem: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(message, hint=hint)
        self.code = code
        self.status = status
        self.retry_after = retry_after
        self.problem: Mapping[str, Any] = problem or {}

    @property
    def request_id(self) -> str:
        return str(self.problem.get("request_id", ""))


class InvalidRequestError(ServiceError):
    @property
    def errors(self) -> list[Mapping[str, Any]]:
        """One entry per wrong field: ``pointer`` (JSON pointer) and ``message``."""
        errors = self.problem.get("errors")
        return [e for e in errors if isinstance(e, dict)] if isinstance(errors, list) else []


class InvalidCoefficientsError(InvalidRequestError):
    pass


class PictureError(ServiceError):
    pass


class InvalidImageError(PictureError):
    pass


class TooLargeError(PictureError):
    pass


class FaceError(PictureError):
    pass


class NoFaceError(FaceError):
    pass


class SeveralFacesError(FaceError):
    @property
    def boxes(self) -> list[tuple[float, float, float, float]]:
        """Left, top, right, bottom of each face in pixels, largest first."""
        boxes = self.problem.get("boxes")
        if not isinstance(boxes, list):
            return []
        return [(b[0], b[1], b[2], b[3]) for b in boxes if isinstance(b, list) and len(b) == 4]


class FaceTooSmallError(FaceError):
    pass


class FaceTurnedError(FaceError):
    pass


class ConsentRequiredError(ServiceError):
    pass


class UnauthorizedError(ServiceError):
    pass


class ForbiddenError(ServiceError):
    pass


class AvatarError(ServiceError):
    pass


class AvatarNotFoundError(AvatarError):
    pass


class AvatarExpiredError(AvatarError):
    pass


class ModelChangedError(AvatarError):
    pass


class IdempotencyError(ServiceError):
    pass


class RetryLaterError(ServiceError):
    pass


class RateLimitedError(RetryLaterError):
    pass


class OverloadedError(RetryLaterError):
    pass


class UnavailableError(RetryLaterError):
    pass


class StoreFullError(ServiceError):
    pass


class InternalServiceError(ServiceError):
    pass


BY_CODE: Mapping[str, type[ServiceError]] = {
    "invalid_request": InvalidRequestError,
    "invalid_json": InvalidRequestError,
    "malformed_request": InvalidRequestError,
    "headers_too_large": InvalidRequestError,
    "malformed_body": InvalidRequestError,
    "not_acceptable": InvalidRequestError,
    "not_found": InvalidRequestError,
    "method_not_allowed": InvalidRequestError,
    "protocol_error": InvalidRequestError,
    "unsupported_version": InvalidRequestError,
    "invalid_coefficients": InvalidCoefficientsError,
    "invalid_image": InvalidImageError,
    "unsupported_media_type": InvalidImageError,
    "image_too_large": TooLargeError,
    "body_too_large": TooLargeError,
    "face_error": FaceError,
    "no_face": NoFaceError,
    "several_faces": SeveralFacesError,
    "face_too_small": FaceTooSmallError,
    "face_turned_away": FaceTurnedError,
    "consent_required": ConsentRequiredError,
    "unauthorized": UnauthorizedError,
    "forbidden": ForbiddenError,
    "avatar_not_found": AvatarNotFoundError,
    "avatar_expired": AvatarExpiredError,
    "invalid_avatar_file": AvatarExpiredError,
    "model_changed": ModelChangedError,
    "idempotency_conflict": IdempotencyError,
    "idempotency_mismatch": IdempotencyError,
    "rate_limited": RateLimitedError,
    "request_timeout": RetryLaterError,
    "overloaded": OverloadedError,
    "draining": UnavailableError,
    "not_ready": UnavailableError,
    "store_full": StoreFullError,
    "internal": InternalServiceError,
}
# For a code that a newer service added.
BY_STATUS: Mapping[int, type[ServiceError]] = {
    401: UnauthorizedError,
    403: ForbiddenError,
    413: TooLargeError,
    415: InvalidImageError,
    429: RateLimitedError,
    503: UnavailableError,
    507: StoreFullError,
}


def service_error(
    problem: Mapping[str, Any], *, status: int = 0, retry_after: float | None = None
) -> ServiceError:
    """The exception for a problem document, or for the error message of a stream."""
    code = str(problem.get("code", ""))
    kind = BY_CODE.get(code) or BY_STATUS.get(status)
    if kind is None:
        kind = InternalServiceError if status >= 500 else InvalidRequestError
    message = problem.get("detail") or problem.get("title") or code or f"status {status}"
    return kind(
        str(message),
        hint=str(problem.get("hint") or ""),
        code=code,
        status=status,
        retry_after=retry_after,
        problem=problem,
    )
