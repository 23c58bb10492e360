"""JSON files with an animation, written by hand, by another program or by ``cvthead track``.

    {"fps": 25, "frames": [{"arkit": {"jawOpen": 0.3}, "global": [0, 0.2, 0]}, ...]}

A frame may hold ``shape`` (100 numbers), ``expression`` (50), ``pose`` (15: global, neck, jaw,
left_eye, right_eye), each of the joints by its name (3), ``arkit`` (an object of names and
weights 0..1) and ``camera`` (scale, tx, ty of the normalised crop). What is absent keeps the
portrait's value. An object without ``frames`` is a single frame. ``tracked`` is ignored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.cli.values import listed, number, read_json
from cvthead.coefficients import EXPRESSION_SIZE, JOINTS, POSE_SIZE, SHAPE_SIZE
from cvthead.controls import FIELDS, Controls, Mode
from cvthead.errors import CoefficientsError

DEFAULT_FPS = 25.0
FRAME_KEYS = ("shape", "expression", "pose", *JOINTS, "arkit", "camera")


@dataclass(frozen=True)
class Motion:
    """Controls of every frame, and frames per second."""

    frames: tuple[Controls, ...]
    fps: float


def read_motion(path: Path, mode: Mode, *, camera: bool) -> Motion:
    """Read an animation.

    Args:
        mode: of the controls.
        camera: False leaves out the frames' cameras.

    Raises:
        CoefficientsError: not JSON or not of the form above; the message names the frame.
    """
    data = read_json(path)
    if not isinstance(data, dict):
        raise CoefficientsError(
            f"{path} holds no object", hint='write {"fps": 25, "frames": [...]}'
        )
    if "frames" not in data:
        data = {"frames": [data]}
    _check_keys(f"{path}", data, ("fps", "frames", "tracked"))
    frames = data["frames"]
    if not isinstance(frames, list) or not frames:
        raise CoefficientsError(f"{path} has no frames", hint="write one frame or more")
    fps = number("fps", data.get("fps", DEFAULT_FPS))
    if not 1 <= fps <= 240:
        raise CoefficientsError(f"fps is {fps:g}", hint="use 1 to 240 frames per second")
    return Motion(tuple(_controls(i, f, mode, camera) for i, f in enumerate(frames)), fps)


def vector_controls(pose: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """A pose (15,) as the rotations that Controls takes, by their field names."""
    return {field: pose[3 * i : 3 * i + 3] for i, field in enumerate(FIELDS.values())}


def _controls(index: int, frame: Any, mode: Mode, camera: bool) -> Controls:
    place = f"frame {index}"
    if not isinstance(frame, dict):
        raise CoefficientsError(f"{place} is not an object", hint='write {"jaw": [0.2, 0, 0]}')
    _check_keys(place, frame, FRAME_KEYS)
    fields: dict[str, Any] = {}
    if "pose" in frame:
        fields |= vector_controls(listed(f"{place} pose", frame["pose"], POSE_SIZE))
    for key, size in (("shape", SHAPE_SIZE), ("expression", EXPRESSION_SIZE)):
        if key in frame:
            fields[key] = listed(f"{place} {key}", frame[key], size)
    for joint, field in FIELDS.items():
        if joint in frame:
            fields[field] = listed(f"{place} {joint}", frame[joint], 3)
    if "arkit" in frame:
        if not isinstance(frame["arkit"], dict):
            raise CoefficientsError(
                f"{place} arkit is not an object", hint='write {"jawOpen": 0.3}'
            )
        fields["arkit"] = {k: number(f"{place} {k}", v) for k, v in frame["arkit"].items()}
    if camera and "camera" in frame:
        fields["camera"] = Camera(*listed(f"{place} camera", frame["camera"], 3).tolist())
    try:
        return Controls(**fields, mode=mode)
    except CoefficientsError as error:
        raise CoefficientsError(f"{place}: {error}", hint=error.hint) from error


def _check_keys(place: str, data: Mapping[str, Any], known: tuple[str, ...]) -> None:
    unknown = [key for key in data if key not in known]
    if unknown:
        raise CoefficientsError(
            f"{place} has an unknown key {unknown[0]!r}", hint=f"use {', '.join(known)}"
        )
