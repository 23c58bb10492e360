"""Training records of the official preset: what its networks say of every frame of a video.

Like those of :mod:`cvthead.training.records`, but every frame can be the source, and coefficients
and camera are DECA's, shape included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvthead.camera import Camera
from cvthead.coefficients import Array, Coefficients
from cvthead.errors import InputError
from cvthead.official.crop import FaceSquare
from cvthead.training.records import (
    MAKER,
    Arrays,
    Frame,
    StoredRecord,
    makers,
    picture_arrays,
    stored_pictures,
    stored_records,
    write_arrays,
)


@dataclass(frozen=True, eq=False)
class OfficialFrame(Frame):
    """A stored frame; mask by face parsing, 0 or 1, coefficients of FLAME.

    Attributes:
        square: what DECA saw of the picture.
        hair: (60,) coefficients of hair and shoulders.
    """

    square: FaceSquare
    hair: Array


def stored_frame(arrays: Arrays, number: int) -> OfficialFrame:
    """A frame of a record."""
    shape, expression, pose, hair = (
        arrays[name][number].astype(np.float32) for name in ("shape", "expression", "pose", "hair")
    )
    return OfficialFrame(
        *stored_pictures(arrays, number),
        Coefficients(shape, expression, pose),
        Camera(*arrays["camera"][number].tolist()),
        FaceSquare(*arrays["square"][number].tolist()),
        hair,
    )


def official_records(folder: Path, tables: str) -> list[StoredRecord]:
    """All records of a folder, by name.

    Args:
        folder: of the records.
        tables: Manifest.tables_fingerprint of the import that should have made them.

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
