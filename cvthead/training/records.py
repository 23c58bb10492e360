"""Tracked training records, one per still or clip: a folder of .npz files, or of tar shards.

A record keeps, for every frame, the 256 x 256 head crop, its masks, coefficients and camera, and
for some frames (the sources) hair, shoulders and visibility as well. One identity has one shape.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.deformation import Deformation
from cvthead.errors import InputError
from cvthead.source import HeadCrop, Source

JPEG_QUALITY = 95
MAKER = "import"  # entry of a record of the preset official

Arrays = dict[str, NDArray[np.generic]]


@dataclass(frozen=True, eq=False)
class Frame:
    """A stored driving frame.

    Attributes:
        image: (256, 256, 3) uint8 RGB.
        mask: (256, 256) float32 person mask.
        valid: (256, 256) bool.
        coefficients, camera: of the tracked head; the camera in normalised crop coordinates.
    """

    image: NDArray[np.uint8]
    mask: NDArray[np.float32]
    valid: NDArray[np.bool_]
    coefficients: Coefficients
    camera: Camera


@dataclass(frozen=True, eq=False)
class Record:
    """An open record; frames are decoded when asked for."""

    arrays: Arrays

    @property
    def frames(self) -> int:
        return len(self.arrays["pose"])

    @property
    def sources(self) -> list[int]:
        """Frame numbers that can serve as source."""
        return [int(i) for i in self.arrays["sources"]]

    def frame(self, number: int) -> Frame:
        a = self.arrays
        coefficients = Coefficients(a["shape"], a["expression"][number], a["pose"][number])  # type: ignore[arg-type]
        camera = Camera(*a["camera"][number].tolist())
        return Frame(*stored_pictures(a, number), coefficients, camera)

    def motion(self, one: int, other: int) -> float:
        """How much two frames differ: mean change of pose in radians plus a tenth of the
        root mean square change of expression."""
        pose, expression = (
            self.arrays[name][one] - self.arrays[name][other] for name in ("pose", "expression")
        )
        return float(np.abs(pose).mean() + 0.1 * np.sqrt(np.square(expression).mean()))

    def deformation(self, number: int) -> Deformation:
        a = self.arrays
        return Deformation(
            a[f"offsets_{number}"].astype(np.float32),
            a[f"shell_anchor_{number}"].astype(np.int32),
            a[f"shell_offset_{number}"].astype(np.float32),
        )

    def visible(self, number: int, points: int) -> NDArray[np.bool_]:
        bits = np.unpackbits(self.arrays[f"visible_{number}"].astype(np.uint8), count=points)
        return bits.astype(bool)


@dataclass(frozen=True)
class StoredRecord:
    """Where a record lies.

    Attributes:
        name: of its own, within the folder.
        frames: how many it holds; 1 for a still.
        path: .npz file or .tar shard.
        offset, size: bytes of the path that are the record.
    """

    name: str
    frames: int
    path: Path
    offset: int
    size: int

    def read(self) -> bytes:
        with self.path.open("rb") as file:
            file.seek(self.offset)
            return file.read(self.size)

    def arrays(self) -> Arrays:
        with np.load(io.BytesIO(self.read()), allow_pickle=False) as archive:
            return dict(archive)

    def open(self) -> Record:
        return Record(self.arrays())


def index_of(shard: Path) -> Path:
    """The file that says where a shard's records lie."""
    return shard.with_suffix(".json")


def stored_records(folder: Path) -> list[StoredRecord]:
    """All records of a folder by name, from .npz files and from tar shards.

    Raises:
        InputError: there are none, or a shard lacks its index.
    """
    stored = []
    for path in folder.glob("*.npz"):
        with np.load(path, allow_pickle=False) as archive:
            frames = len(archive["pose"])
        stored.append(StoredRecord(path.name, frames, path, 0, path.stat().st_size))
    for shard in folder.glob("*.tar"):
        try:
            index = json.loads(index_of(shard).read_bytes())
        except (OSError, ValueError) as error:
            raise InputError(
                f"{shard} has no readable index {index_of(shard).name}",
                hint="copy the .json files beside the shards as well",
            ) from error
        stored += [
            StoredRecord(f"{key}.npz", at["frames"], shard, at["offset"], at["size"])
            for key, at in index.items()
        ]
    if not stored:
        raise InputError(
            f"no records in {folder}", hint="make them with `cvthead data prepare VIDEOS OUT`"
        )
    return sorted(stored, key=lambda record: record.name)


def open_records(folder: Path) -> list[StoredRecord]:
    """As :func:`stored_records`, of the open preset.

    Raises:
        InputError: as :func:`stored_records`, or some were made for the preset official.
    """
    stored = stored_records(folder)
    if any(makers(stored)):
        raise InputError(
            f"{folder} has records of the preset official",
            hint="make others with `cvthead data prepare VIDEOS OUT`",
        )
    return stored


def makers(stored: Sequence[StoredRecord]) -> set[str]:
    """Fingerprints of the imports that made the records; "" is the open preset. All records of a
    shard have one maker."""
    found = set()
    for record in {record.path: record for record in stored}.values():
        # A file is opened without reading all of it.
        file = record.path if record.path.suffix == ".npz" else io.BytesIO(record.read())
        with np.load(file, allow_pickle=False) as archive:
            found.add(str(archive[MAKER]) if MAKER in archive else "")
    return found


def records_hash(folder: Path) -> str:
    """SHA-256 over names and contents of the records; the same for files and for shards."""
    digest = hashlib.sha256()
    for record in stored_records(folder):
        digest.update(record.name.encode())
        digest.update(record.read())
    return digest.hexdigest()


def write(path: Path, heads: list[HeadCrop], sources: dict[int, Source]) -> None:
    """Store the frames of one identity; ``sources`` by frame number."""
    arrays: Arrays = {
        "shape": heads[0].coefficients.shape,
        "expression": np.stack([h.coefficients.expression for h in heads]),
        "pose": np.stack([h.coefficients.pose for h in heads]),
        "camera": np.array([[h.camera.scale, h.camera.tx, h.camera.ty] for h in heads]),
        "sources": np.array(sorted(sources)),
    }
    for number, head in enumerate(heads):
        arrays |= picture_arrays(number, head.image, head.mask, head.valid)
    for number, source in sources.items():
        arrays[f"offsets_{number}"] = source.deformation.offsets.astype(np.float16)
        arrays[f"shell_anchor_{number}"] = source.deformation.shell_anchor
        arrays[f"shell_offset_{number}"] = source.deformation.shell_offset.astype(np.float16)
        arrays[f"visible_{number}"] = np.packbits(source.visible)
    write_arrays(path, arrays)


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Store a record's arrays, all or none."""
    temporary = path.with_suffix(".tmp.npz")
    np.savez(temporary, **arrays)  # type: ignore[arg-type]
    temporary.rename(path)


def picture_arrays(
    number: int, image: NDArray[np.uint8], mask: NDArray[np.float32], valid: NDArray[np.bool_]
) -> Arrays:
    """A frame's pictures as a record stores them; arguments as in :class:`Frame`."""
    person, inside = (mask * 255).astype(np.uint8), valid.astype(np.uint8) * 255
    return {
        f"image_{number}": _encoded(".jpg", image[..., ::-1]),
        f"mask_{number}": _encoded(".png", np.stack([person * 0, inside, person], axis=-1)),
    }


def stored_pictures(
    arrays: Arrays, number: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]:
    """Image, mask and valid of a frame, see :class:`Frame`."""
    image, masks = (
        cv2.imdecode(arrays[f"{name}_{number}"].astype(np.uint8), cv2.IMREAD_COLOR_RGB)
        for name in ("image", "mask")
    )
    assert image is not None
    assert masks is not None
    person = masks[..., 0].astype(np.float32) / np.float32(255)
    return image.astype(np.uint8), person, masks[..., 1] > 127


def _encoded(kind: str, image: NDArray[np.generic]) -> NDArray[np.uint8]:
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if kind == ".jpg" else []
    done, data = cv2.imencode(kind, np.ascontiguousarray(image), quality)
    assert done
    return data.astype(np.uint8)
