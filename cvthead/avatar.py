"""An avatar: everything a frame needs that depends on the source portrait alone."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from cvthead.avatar_file import opened, packed
from cvthead.camera import CROP_PIXELS, Camera, Crop
from cvthead.coefficients import EXPRESSION_SIZE, POSE_SIZE, SHAPE_SIZE, Coefficients
from cvthead.deformation import MAX_SHELL_POINTS, Deformation
from cvthead.files import write_file
from cvthead.images import DAMAGE
from cvthead.points import SEEN
from cvthead.runtime.ghosts import point_owners
from cvthead.runtime.seams import outline_rim

FORMAT = "cvthead-avatar"
VERSION = "3"
PLACE_SIZE = 3  # x, y, seen
CAMERA_FIELDS = ("scale", "tx", "ty")
CROP_FIELDS = ("left", "top", "size")
# Type (in safetensors' spelling) and shape of each array of a file. Letters stand for sizes that
# differ from avatar to avatar: points, channels, vertices, shell points, bytes.
ARRAYS: dict[str, tuple[str, tuple[int | str, ...]]] = {
    "descriptors": ("U8", ("P", "C")),
    "places": ("F16", ("P", PLACE_SIZE)),
    "offsets": ("F16", ("N", 3)),
    "shell_anchor": ("I32", ("K",)),
    "shell_offset": ("F16", ("K", 3)),
    "shape": ("F32", (SHAPE_SIZE,)),
    "expression": ("F32", (EXPRESSION_SIZE,)),
    "pose": ("F32", (POSE_SIZE,)),
    "camera": ("F64", (len(CAMERA_FIELDS),)),
    "crop": ("F64", (len(CROP_FIELDS),)),
    "drawn": ("BOOL", ("P",)),
    "portrait": ("U8", ("D",)),
    "background": ("U8", ("B",)),
}


@dataclass(frozen=True, eq=False)
class Avatar:
    """One encoded portrait. Immutable; the encoder never runs again for it.

    Attributes:
        descriptors: (P, C) uint8, V_F of the paper's section 3.3 as codes that the frame network
            reads, in the order of the preset's PointLayout without the unused shell points.
        places: (P, 3) float16, each point's normalised x and y in the portrait, and 1 where the
            portrait sees it, 0.5 where it sees only the mirrored point, else 0.
        drawn: (P,) bool, points that belong to the avatar; of the others, which the portrait cuts
            off, nothing is known.
        portrait: (256, 256, 4) uint8, the cropped person: RGB multiplied by the mask (grey 128
            where there is no person), then the mask.
        deformation: hair and shoulders, in rest space.
        coefficients: of the portrait.
        camera: of the portrait, in the crop's normalised coordinates.
        crop: the square of the portrait that was encoded, in pixels of the portrait.
        background: JPEG of the crop, 256 x 256, the person painted away.
        preset: "open" or "official".
        fingerprint: of the trained weights that made the descriptors.
    """

    descriptors: NDArray[np.uint8]
    places: NDArray[np.float16]
    drawn: NDArray[np.bool_]
    portrait: NDArray[np.uint8]
    deformation: Deformation
    coefficients: Coefficients
    camera: Camera
    crop: Crop
    background: bytes
    preset: str
    fingerprint: str

    def __post_init__(self) -> None:
        for name in ("descriptors", "places", "drawn", "portrait"):
            constant = getattr(self, name).view()
            constant.flags.writeable = False  # shared between threads
            object.__setattr__(self, name, constant)

    @cached_property
    def exact_places(self) -> NDArray[np.float32]:
        """The places in single precision, converted once."""
        return self.places.astype(np.float32)

    @cached_property
    def owners(self) -> NDArray[np.int32]:
        """The point that each pixel of the portrait belongs to, found once; see
        cvthead.runtime.ghosts."""
        return point_owners(self.exact_places, self.exact_places[:, 2] == SEEN)

    @cached_property
    def rim(self) -> NDArray[np.float32]:
        """Where the portrait is mixed with what was behind it; see cvthead.runtime.seams."""
        return outline_rim(self.portrait)

    def to_bytes(self) -> bytes:
        """One safetensors file of less than 1 MB."""
        tensors: dict[str, NDArray[Any]] = {
            "descriptors": self.descriptors,
            "places": self.places,
            "drawn": self.drawn,
            "offsets": self.deformation.offsets.astype(np.float16),
            "shell_anchor": self.deformation.shell_anchor,
            "shell_offset": self.deformation.shell_offset.astype(np.float16),
            "shape": self.coefficients.shape,
            "expression": self.coefficients.expression,
            "pose": self.coefficients.pose,
            "camera": np.array([getattr(self.camera, f) for f in CAMERA_FIELDS], np.float64),
            "crop": np.array([getattr(self.crop, f) for f in CROP_FIELDS], np.float64),
            "portrait": np.frombuffer(_to_png(self.portrait), np.uint8),
            "background": np.frombuffer(self.background, np.uint8),
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
    def load(cls, path: Path | str) -> Avatar:
        """Read a file written by :meth:`save`. The file may come from anywhere: types, shapes
        and ranges are checked here, whether they fit the loaded head model by the Pipeline.

        Raises:
            AvatarFileError: missing, truncated, not an avatar, of another version, or with
                contents that :meth:`save` does not write.
        """
        hint = "encode the portrait again with `cvthead encode`"
        with opened(path, "an avatar file", hint=hint) as file:
            metadata = file.metadata() or {}
            _check_metadata(metadata)
            _check_arrays(file)
            return _avatar({name: file.get_tensor(name) for name in ARRAYS}, metadata)


def _check_metadata(metadata: dict[str, str]) -> None:
    if metadata.get("format") != FORMAT:
        raise ValueError(f"its format is not {FORMAT}")
    if metadata.get("version") != VERSION:
        raise ValueError(f"format version {metadata.get('version')!r}, expected {VERSION}")
    # Both are shown in messages.
    for name, pattern in (("preset", "[a-z]{1,16}"), ("fingerprint", "[0-9a-f]{16}")):
        if not re.fullmatch(pattern, metadata.get(name, "")):
            raise ValueError(f"its {name} is missing or malformed")


def _check_arrays(file: Any) -> None:
    """Types and shapes, from the header alone: safetensors' reader fails on types that NumPy
    lacks, and NumPy would broadcast wrong shapes or take indices from the other end."""
    present = set(file.keys())
    sizes: dict[str, int] = {}
    for name, (kind, shape) in ARRAYS.items():
        if name not in present:
            raise ValueError(f"{name} is missing")
        header = file.get_slice(name)
        if header.get_dtype() != kind:
            raise ValueError(f"{name} has type {header.get_dtype()}, expected {kind}")
        found = header.get_shape()
        wanted = [
            size if isinstance(size, int) else sizes.setdefault(size, length)
            for size, length in zip(shape, found, strict=False)
        ]
        if len(found) != len(shape) or found != wanted:
            raise ValueError(f"{name} has shape {found}, expected {list(shape)}")
    if sizes["K"] > MAX_SHELL_POINTS:
        raise ValueError(f"{sizes['K']} shell points, at most {MAX_SHELL_POINTS} are possible")
    if 0 in (sizes["N"], sizes["C"]) or sizes["N"] + sizes["K"] > sizes["P"]:
        raise ValueError("fewer descriptors than vertices and shell points")


def _avatar(arrays: dict[str, NDArray[Any]], metadata: dict[str, str]) -> Avatar:
    for name in ("places", "offsets", "shell_offset", "crop"):
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} holds NaN or infinity")
    anchor = arrays["shell_anchor"]
    if ((anchor < 0) | (anchor >= len(arrays["offsets"]))).any():
        raise ValueError("shell_anchor names a vertex that does not exist")
    camera, crop = Camera(*arrays["camera"].tolist()), Crop(*arrays["crop"].tolist())
    camera.check()
    if crop.size <= 0:
        raise ValueError(f"crop has size {crop.size:g}")
    background = arrays["background"].tobytes()
    _picture("background", background, JpegImageFile, "RGB")
    return Avatar(
        arrays["descriptors"],
        arrays["places"],
        arrays["drawn"],
        _picture("portrait", arrays["portrait"].tobytes(), PngImageFile, "RGBA"),
        Deformation(
            arrays["offsets"].astype(np.float32), anchor, arrays["shell_offset"].astype(np.float32)
        ),
        Coefficients(arrays["shape"], arrays["expression"], arrays["pose"]),
        camera,
        crop,
        background,
        metadata["preset"],
        metadata["fingerprint"],
    )


def _to_png(image: NDArray[np.uint8]) -> bytes:
    out = BytesIO()
    Image.fromarray(image).save(out, "PNG", compress_level=3)
    return out.getvalue()


def _picture(name: str, data: bytes, kind: type[ImageFile], mode: str) -> NDArray[np.uint8]:
    """A whole picture of the crop's size; the size is checked before a pixel is decoded."""
    try:
        with kind(BytesIO(data)) as image:
            found = (*image.size, image.mode)
            if found == (CROP_PIXELS, CROP_PIXELS, mode):
                image.load()
                return np.array(image)
    except DAMAGE as error:
        raise ValueError(f"{name} is not a {kind.format} picture") from error
    raise ValueError(f"{name} is {found[0]} x {found[1]} px, {found[2]}")
