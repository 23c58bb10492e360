"""An avatar: everything a frame needs that depends on the source portrait alone."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as save_tensors

from cvthead.camera import Camera, Crop
from cvthead.coefficients import Coefficients
from cvthead.deformation import Deformation
from cvthead.errors import AvatarFileError, CVTHeadError
from cvthead.files import atomic_path

FORMAT = "cvthead-avatar"
VERSION = "1"
CAMERA_FIELDS = ("scale", "tx", "ty")
CROP_FIELDS = ("left", "top", "size")


@dataclass(frozen=True, eq=False)
class Avatar:
    """One encoded portrait. Immutable; the encoder never runs again for it.

    Attributes:
        descriptors: (P, C) float16, in the order of the preset's PointLayout without the unused
            shell points (paper section 3.3, V_F).
        deformation: hair and shoulders, in rest space.
        coefficients: of the portrait.
        camera: of the portrait, in the crop's normalised coordinates.
        crop: the square of the portrait that was encoded, in pixels of the portrait.
        background: JPEG of the crop, 256 x 256, the person painted away.
        preset: "open" or "official".
        fingerprint: of the trained weights that made the descriptors.
    """

    descriptors: NDArray[np.float16]
    deformation: Deformation
    coefficients: Coefficients
    camera: Camera
    crop: Crop
    background: bytes
    preset: str
    fingerprint: str

    def to_bytes(self) -> bytes:
        """One safetensors file of less than 1 MB."""
        tensors = {
            "descriptors": self.descriptors,
            "offsets": self.deformation.offsets.astype(np.float16),
            "shell_anchor": self.deformation.shell_anchor,
            "shell_offset": self.deformation.shell_offset.astype(np.float16),
            "shape": self.coefficients.shape,
            "expression": self.coefficients.expression,
            "pose": self.coefficients.pose,
            "camera": np.array([getattr(self.camera, f) for f in CAMERA_FIELDS]),
            "crop": np.array([getattr(self.crop, f) for f in CROP_FIELDS], np.float64),
            "background": np.frombuffer(self.background, np.uint8),
        }
        metadata = {
            "format": FORMAT,
            "version": VERSION,
            "preset": self.preset,
            "fingerprint": self.fingerprint,
        }
        contiguous = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
        return save_tensors(contiguous, metadata=metadata)

    def save(self, path: Path | str) -> None:
        """Write the file; an existing one is replaced only when the new one is complete."""
        with atomic_path(Path(path)) as temporary:
            temporary.write_bytes(self.to_bytes())

    @classmethod
    def load(cls, path: Path | str) -> Avatar:
        """Read a file written by :meth:`save`.

        Raises:
            AvatarFileError: missing, truncated, not an avatar, or of another version.
        """
        hint = "encode the portrait again with `cvthead encode`"
        try:
            with safe_open(str(path), framework="np") as file:
                metadata = file.metadata() or {}
                if metadata.get("format") != FORMAT:
                    raise AvatarFileError(f"{path} is not an avatar file", hint=hint)
                if metadata.get("version") != VERSION:
                    raise AvatarFileError(
                        f"{path} has format version {metadata.get('version')}, expected {VERSION}",
                        hint=hint,
                    )
                t = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return cls(
                t["descriptors"],
                Deformation(
                    t["offsets"].astype(np.float32),
                    t["shell_anchor"],
                    t["shell_offset"].astype(np.float32),
                ),
                Coefficients(t["shape"], t["expression"], t["pose"]),
                Camera(*t["camera"].tolist()),
                Crop(*t["crop"].tolist()),
                t["background"].tobytes(),
                metadata["preset"],
                metadata["fingerprint"],
            )
        except FileNotFoundError as error:
            raise AvatarFileError(f"{path} does not exist", hint=hint) from error
        except (SafetensorError, KeyError, OSError, TypeError, json.JSONDecodeError) as error:
            raise AvatarFileError(f"{path} is damaged: {error}", hint=hint) from error
        except CVTHeadError as error:
            if isinstance(error, AvatarFileError):
                raise
            raise AvatarFileError(f"{path} is damaged: {error}", hint=hint) from error
