"""Every error a caller can act on, in one hierarchy.

    CVTHeadError
    |-- InputError                  the caller's data is at fault
    |   |-- ImageError              truncated, damaged, too small
    |   |   |-- ImageTypeError      not a PNG, JPEG or WebP picture
    |   |   `-- ImageTooLargeError  more pixels or bytes than are decoded
    |   |-- CoefficientsError       wrong length, NaN, out of range, unknown ARKit name
    |   |-- FaceError
    |   |   |-- NoFaceError
    |   |   |-- SeveralFacesError   exactly one was asked for; carries the boxes
    |   |   |-- FaceTooSmallError
    |   |   `-- FaceTurnedError     presence under the gate: profile or occluded
    |   `-- VideoError
    |-- AvatarError
    |   |-- AvatarFileError         not an avatar file, truncated, other format version
    |   |-- ModelChangedError       made with other trained weights
    |   |-- AvatarNotFoundError
    |   |-- AvatarExpiredError
    |   `-- StoreError              the store cannot be written
    `-- AssetError                  a file of the installed package is missing or altered

The message says what is wrong; ``hint`` says what to do next; ``code`` is stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar


class CVTHeadError(Exception):
    """Base of all errors raised on purpose by this package."""

    code: ClassVar[str] = "error"

    def __init__(self, message: str, *, hint: str) -> None:
        super().__init__(message)
        self.hint = hint

    def __reduce__(self) -> tuple[Any, ...]:
        # An error of a worker process keeps its type and all it carries.
        return _rebuilt, (type(self), self.args, vars(self))


class InputError(CVTHeadError):
    code = "invalid_input"


class ImageError(InputError):
    code = "invalid_image"


class ImageTypeError(ImageError):
    code = "unsupported_media_type"


class ImageTooLargeError(ImageError):
    code = "image_too_large"


class VideoError(InputError):
    code = "invalid_video"


class CoefficientsError(InputError):
    code = "invalid_coefficients"


class FaceError(InputError):
    code = "face_error"


class NoFaceError(FaceError):
    code = "no_face"


class SeveralFacesError(FaceError):
    """More than one face where exactly one was asked for.

    ``boxes``: (left, top, right, bottom) in pixels, largest face first.
    """

    code = "several_faces"

    def __init__(
        self, message: str, *, hint: str, boxes: Sequence[tuple[float, float, float, float]]
    ) -> None:
        super().__init__(message, hint=hint)
        self.boxes = tuple(boxes)


class FaceTooSmallError(FaceError):
    code = "face_too_small"


class FaceTurnedError(FaceError):
    code = "face_turned_away"


class AvatarError(CVTHeadError):
    code = "avatar_error"


class AvatarFileError(AvatarError):
    code = "invalid_avatar_file"


class ModelChangedError(AvatarError):
    code = "model_changed"


class AvatarNotFoundError(AvatarError):
    code = "avatar_not_found"


class AvatarExpiredError(AvatarError):
    code = "avatar_expired"


class StoreError(AvatarError):
    code = "store_full"


class AssetError(CVTHeadError):
    code = "asset_error"


def _rebuilt(
    kind: type[CVTHeadError], args: tuple[Any, ...], state: dict[str, Any]
) -> CVTHeadError:
    error = kind.__new__(kind)
    error.args = args
    vars(error).update(state)
    return error
