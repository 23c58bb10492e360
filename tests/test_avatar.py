"""Avatar files, also forged ones: whatever is wrong is found when the file is loaded."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_avatars import arrays, jpeg, made_avatar, plain, png
from safetensors.numpy import load, save

from cvthead.avatar import Avatar
from cvthead.avatar_file import MAX_BYTES
from cvthead.errors import AvatarFileError

METADATA = {
    "format": "cvthead-avatar",
    "version": "3",
    "preset": "open",
    "fingerprint": "0123456789abcdef",
}
NAN, INFINITY = float("nan"), float("inf")


def tensors() -> dict[str, np.ndarray]:
    """Of an avatar with 50 points, 30 vertices and 7 shell points."""
    return load(made_avatar().to_bytes())


def written(path: Path, changed: dict[str, Any], metadata: dict[str, str] = METADATA) -> Path:
    """An avatar file with some arrays replaced; None leaves one out."""
    everything = {k: v for k, v in (tensors() | changed).items() if v is not None}
    file = path / "forged.avatar"
    file.write_bytes(save(everything, metadata=metadata))
    return file


def with_value(name: str, index: Any, value: float) -> dict[str, np.ndarray]:
    array = tensors()[name].copy()
    array[index] = value
    return {name: array}


def codes(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.uint8)


def half(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float16)


def test_round_trip(tmp_path: Path) -> None:
    before = made_avatar(3)
    before.save(tmp_path / "a.avatar")
    after = Avatar.load(tmp_path / "a.avatar")
    assert plain(before) == plain(after)
    assert all(map(np.array_equal, arrays(before), arrays(after)))
    assert Avatar.load(written(tmp_path, {})).fingerprint == METADATA["fingerprint"]


def test_arrays_cannot_be_changed() -> None:
    for array in arrays(made_avatar()):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        # missing, and of other types
        *(({name: None}, f"{name} is missing") for name in tensors()),
        *(({name: tensors()[name].astype(np.int16)}, f"{name} has type") for name in tensors()),
        ({"shell_anchor": tensors()["shell_anchor"].astype(np.uint32)}, "shell_anchor has type"),
        # shapes, among them some that NumPy would broadcast
        ({"descriptors": codes(50)}, "descriptors has shape"),
        ({"descriptors": codes(50, 0)}, "descriptors"),
        ({"places": half(50, 2)}, "places has shape"),
        ({"places": half(49, 3)}, "places has shape"),
        (
            {"descriptors": codes(36, 24), "places": half(36, 3), "drawn": np.ones(36, bool)},
            "fewer descriptors",
        ),
        ({"offsets": half(3)}, "offsets has shape"),
        ({"offsets": half(30, 1)}, "offsets has shape"),
        ({"offsets": half(1, 30, 3)}, "offsets has shape"),
        ({"offsets": half(0, 3)}, "descriptors"),
        ({"shell_offset": half(6, 3)}, "shell_offset has shape"),
        ({"shell_offset": half(3)}, "shell_offset has shape"),
        ({"shell_anchor": np.zeros((), np.int32)}, "shell_anchor has shape"),
        (
            {
                "descriptors": codes(600, 24),
                "places": half(600, 3),
                "drawn": np.ones(600, bool),
                "shell_anchor": np.zeros(513, np.int32),
                "shell_offset": half(513, 3),
            },
            "513 shell points",
        ),
        ({"pose": np.zeros(14, np.float32)}, "pose has shape"),
        ({"camera": np.ones(4)}, "camera has shape"),
        ({"camera": np.ones((3, 1))}, "camera has shape"),
        # values
        (with_value("places", (4, 2), NAN), "places holds NaN"),
        (with_value("offsets", (0, 0), INFINITY), "offsets holds NaN"),
        (with_value("shell_offset", (0, 0), -INFINITY), "shell_offset holds NaN"),
        (with_value("shell_anchor", 0, 30), "shell_anchor names a vertex"),
        (with_value("shell_anchor", 6, -1), "shell_anchor names a vertex"),
        (with_value("expression", 7, NAN), "expression holds NaN"),
        (with_value("shape", 7, 1e9), "shape"),
        (with_value("camera", 0, 0), "camera has scale 0"),
        (with_value("camera", 0, -5), "camera has scale -5"),
        (with_value("camera", 0, 1e300), "camera"),
        (with_value("camera", 2, NAN), "camera holds NaN"),
        (with_value("crop", 1, NAN), "crop holds NaN"),
        (with_value("crop", 2, 0), "crop has size 0"),
        *(
            ({"background": np.frombuffer(data, np.uint8)}, "background is")
            for data in (b"", b"\xff\xd8\xff", jpeg()[:300], jpeg(64), jpeg(mode="L"))
        ),
        *(
            ({"portrait": np.frombuffer(data, np.uint8)}, "portrait is")
            for data in (b"", b"\x89PNG", png()[:100], png(64), png(mode="RGB"), jpeg())
        ),
    ],
)
def test_forged_contents_are_refused(changed: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(AvatarFileError, match=message):
        Avatar.load(written(tmp_path, changed))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"format": "other"}, "format"),
        ({"version": "1"}, "version '1'"),
        ({"preset": "../../x"}, "preset"),
        ({"fingerprint": "\x1b[2J"}, "fingerprint"),
        ({"fingerprint": ""}, "fingerprint"),
    ],
)
def test_forged_metadata_is_refused(changed: dict[str, str], message: str, tmp_path: Path) -> None:
    with pytest.raises(AvatarFileError, match=message):
        Avatar.load(written(tmp_path, {}, METADATA | changed))


@pytest.mark.parametrize("kind", ["BF16", "F8_E4M3", "F64"])
def test_types_that_numpy_lacks_are_refused(kind: str, tmp_path: Path) -> None:
    size = {"BF16": 2, "F8_E4M3": 1, "F64": 8}[kind]
    entry = {"dtype": kind, "shape": [1, 1], "data_offsets": [0, size]}
    header = json.dumps({"__metadata__": METADATA, "descriptors": entry}).encode()
    file = tmp_path / "forged.avatar"
    file.write_bytes(struct.pack("<Q", len(header)) + header + bytes(size))
    with pytest.raises(AvatarFileError, match=f"descriptors has type {kind}"):
        Avatar.load(file)


def test_files_that_are_none(tmp_path: Path) -> None:
    file = tmp_path / "x.avatar"
    for data in (b"", b"x" * 100, struct.pack("<Q", 2**40) + b"{}", bytes(MAX_BYTES + 1)):
        file.write_bytes(data)
        with pytest.raises(AvatarFileError, match="damaged or not an avatar"):
            Avatar.load(file)
    with pytest.raises(AvatarFileError, match="damaged or not an avatar"):
        Avatar.load(tmp_path)
    with pytest.raises(AvatarFileError, match="does not exist"):
        Avatar.load(tmp_path / "missing.avatar")
