"""Training records of the official preset: what its networks say of every frame of a video.

Like those of :mod:`cvthead.training.records`, but every frame can be the source, and coefficients
and camera are DECA's, shape included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.coefficients import Array, Coefficients
from cvthead.errors import InputError
from cvthead.official.crop import FaceSquare
from cvthead.training.records import (
    MAKER,
    Arrays,
    StoredRecord,
    makers,
    picture_arrays,
    stored_pictures,
    stored_records,
    write_arrays,
)


@dataclass(frozen=True, eq=False)
class OfficialFrame:
    """A stored frame.

    Attributes:
        image: (256, 256, 3) uint8 RGB.
        mask: (256, 256) float32 of 0 and 1, face parsing's.
        valid: (256, 256) bool, False beyond the video's picture.
        coefficients: of FLAME.
        camera: in the picture's normalised coordinates.
        square: what DECA saw of the picture.
        hair: (60,) coefficients of hair and shoulders.
    """

    image: NDArray[np.uint8]
    mask: Array
    valid: NDArray[np.bool_]
    coefficients: Coefficients
    camera: Camera
    square: FaceSquare
    hair: Array


@dataclass(frozen=True, eq=False)
class OfficialRecord:
    """An open record; frames are decoded when asked for."""

    arrays: Arrays

    @property
    def frames(self) -> int:
        return len(self.arrays["pose"])

    def frame(self, number: int) -> OfficialFrame:
        a = self.arrays
        shape, expression, pose, hair = (
            a[name][number].astype(np.float32) for name in ("shape", "expression", "pose", "hair")
        )
        return OfficialFrame(
            *stored_pictures(a, number),
            Coefficients(shape, expression, pose),
            Camera(*a["camera"][number].tolist()),
            FaceSquare(*a["square"][number].tolist()),
            hair,
        )


def official_records(folder: Path, tables: str) -> list[StoredRecord]:
    """All records of a folder, by name.

    Args:
        folder: of the records.
        tables: fingerprint of the import that should have made them, see Manifest.tables.

    Raises:
        InputError: there are none, or some were made for the open preset or with another import.
    """
    stored = stored_records(folder)
    for maker in makers(stored):
        if maker != tables:
            raise InputError(
                f"{folder} has records of "
                + (f"the import {maker}" if maker else "the open preset"),
                hint="make others with `cvthead data prepare --preset official VIDEOS OUT`",
            )
    return stored


def write(path: Path, frames: Sequence[OfficialFrame], tables: str) -> None:
    """Store the frames of one video; ``tables`` as in :func:`official_records`."""
    arrays: Arrays = {
        MAKER: np.array(tables),
        "shape": np.stack([f.coefficients.shape for f in frames]),
        "expression": np.stack([f.coefficients.expression for f in frames]),
        "pose": np.stack([f.coefficients.pose for f in frames]),
        "camera": np.array([[f.camera.scale, f.camera.tx, f.camera.ty] for f in frames]),
        "square": np.array([[f.square.x, f.square.y, f.square.size] for f in frames]),
        "hair": np.stack([f.hair for f in frames]),
    }
    for number, frame in enumerate(frames):
        arrays |= picture_arrays(number, frame.image, frame.mask, frame.valid)
    write_arrays(path, arrays)
