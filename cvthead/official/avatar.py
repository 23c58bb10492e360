"""An avatar of the official preset: all that depends on the source picture alone."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from cvthead.avatar_file import opened, packed
from cvthead.camera import CROP_PIXELS, Camera, Crop
from cvthead.coefficients import EXPRESSION_SIZE, POSE_SIZE, SHAPE_SIZE, Coefficients
from cvthead.files import write_file
from cvthead.model.config import PAPER
from cvthead.official.crop import FaceSquare
from cvthead.official.manifest import PRESET

FORMAT = "cvthead-official-avatar"
VERSION = "2"
VERTICES = 5023  # of FLAME
ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "descriptors": ("F32", (VERTICES, PAPER.descriptor_size)),
    "offsets": ("F32", (VERTICES, 3)),
    "shape": ("F32", (SHAPE_SIZE,)),
    "expression": ("F32", (EXPRESSION_SIZE,)),
    "pose": ("F32", (POSE_SIZE,)),
    "camera": ("F64", (3,)),
    "square": ("F64", (3,)),
    "crop": ("F64", (3,)),
    "background": ("U8", (CROP_PIXELS, CROP_PIXELS, 3)),
}

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class OfficialAvatar:
    """One encoded portrait. Immutable; the encoder never runs again for it.

    Attributes:
        descriptors: (5023, 32), V_F of the paper's section 3.3.
        offsets: (5023, 3) hair and shoulders in metres, added after posing: they do not turn
            with the head, as in the released code.
        coefficients: of the portrait, of FLAME.
        camera: of the portrait, in the 256 x 256 picture's normalised coordinates.
        square: what DECA saw of the 256 x 256 picture.
        crop: the square of the portrait that became that picture, in pixels of the portrait.
        background: (256, 256, 3) uint8 RGB, the picture with the person painted away.
        fingerprint: of the weights that made it.
    """

    descriptors: Array
    offsets: Array
    coefficients: Coefficients
    camera: Camera
    square: FaceSquare
    crop: Crop
    background: NDArray[np.uint8]
    fingerprint: str

    @property
    def preset(self) -> str:
        return PRESET

    def to_bytes(self) -> bytes:
        """One safetensors file."""
        camera, square, crop = self.camera, self.square, self.crop
        tensors = {
            "descriptors": self.descriptors,
            "offsets": self.offsets,
            "shape": self.coefficients.shape,
            "expression": self.coefficients.expression,
            "pose": self.coefficients.pose,
            "camera": np.array([camera.scale, camera.tx, camera.ty]),
            "square": np.array([square.x, square.y, square.size]),
            "crop": np.array([crop.left, crop.top, crop.size], np.float64),
            "background": self.background,
        }
        metadata = {
            "format": FORMAT,
            "version": VERSION,
            "preset": self.preset,
            "fingerprint": self.fingerprint,
        }
        return packed(tensors, metadata)

    def save(self, path: Path | str) -> None:
        """Write the file; an existing one is replaced only when the new one is complete.

        Raises:
            InputError: the file cannot be written.
        """
        write_file(path, self.to_bytes())

    @classmethod
    def load(cls, path: Path | str) -> OfficialAvatar:
        """Read a file written by :meth:`save`; it may come from anywhere.

        Raises:
            AvatarFileError: missing, damaged, not such an avatar, or with impossible contents.
        """
        hint = "encode the portrait again"
        with opened(path, "an avatar of the official preset", hint=hint) as file:
            metadata = file.metadata() or {}
            if (metadata.get("format"), metadata.get("version")) != (FORMAT, VERSION):
                raise ValueError(f"its format is not {FORMAT} {VERSION}")
            fingerprint = metadata.get("fingerprint", "")
            if not re.fullmatch("[0-9a-f]{16}", fingerprint):
                raise ValueError("its fingerprint is missing or malformed")
            return _avatar({name: _array(file, name) for name in ARRAYS}, fingerprint)


def is_official(path: Path) -> bool:
    """Whether a file is an avatar of this preset; False also for one that cannot be read."""
    try:
        with safe_open(str(path), framework="np") as file:
            return (file.metadata() or {}).get("format") == FORMAT
    except (SafetensorError, OSError):
        return False


def _array(file: Any, name: str) -> NDArray[Any]:
    kind, shape = ARRAYS[name]
    if name not in file.keys():  # noqa: SIM118  (not a mapping)
        raise ValueError(f"{name} is missing")
    header = file.get_slice(name)
    found = header.get_dtype(), tuple(header.get_shape())
    if found != (kind, shape):
        raise ValueError(f"{name} is {found[0]} {found[1]}, expected {kind} {shape}")
    array: NDArray[Any] = file.get_tensor(name)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds NaN or infinity")
    return array


def _avatar(arrays: dict[str, NDArray[Any]], fingerprint: str) -> OfficialAvatar:
    camera, square = Camera(*arrays["camera"].tolist()), FaceSquare(*arrays["square"].tolist())
    crop = Crop(*arrays["crop"].tolist())
    camera.check()
    if square.size < 1:
        raise ValueError(f"the face square has size {square.size:g}")
    if crop.size <= 0:
        raise ValueError(f"crop has size {crop.size:g}")
    return OfficialAvatar(
        arrays["descriptors"],
        arrays["offsets"],
        Coefficients(arrays["shape"], arrays["expression"], arrays["pose"]),
        camera,
        square,
        crop,
        arrays["background"],
        fingerprint,
    )
