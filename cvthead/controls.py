"""What a caller asks of a frame: any part of the coefficients, the rest stays the source's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvthead.camera import Camera
from cvthead.coefficients import (
    EXPRESSION_SIZE,
    JOINTS,
    SHAPE_SIZE,
    Coefficients,
    checked,
)
from cvthead.errors import CoefficientsError
from cvthead.head.arkit import ArkitMap

Mode = Literal["absolute", "relative"]


@dataclass(frozen=True, eq=False)
class Controls:
    """A partial set of coefficients. None keeps the source's value; 0 means zero.

    Attributes:
        shape: (100,) standard deviations.
        expression: (50,) standard deviations.
        global_rotation, neck, jaw, left_eye, right_eye: (3,) axis-angle, radians.
        arkit: ARKit blendshape name -> 0..1. Adds its expression and replaces jaw and eye
            rotations that are not given here. In absolute mode it starts from the neutral
            expression unless ``expression`` is given.
        camera: normalised weak-perspective camera; replaces the source's in both modes.
        mode: "absolute" replaces the source's values, "relative" adds to them (rotations are
            composed, the control's after the source's).

    Raises:
        CoefficientsError: wrong length, NaN, out of range or unknown mode. ARKit names and
            weights are checked by :func:`resolve`.
    """

    shape: ArrayLike | None = None
    expression: ArrayLike | None = None
    global_rotation: ArrayLike | None = None
    neck: ArrayLike | None = None
    jaw: ArrayLike | None = None
    left_eye: ArrayLike | None = None
    right_eye: ArrayLike | None = None
    arkit: Mapping[str, float] | None = None
    camera: Camera | None = None
    mode: Mode = "absolute"

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise CoefficientsError(
                f"mode is {self.mode!r}", hint="use " + " or ".join(get_args(Mode))
            )
        for name, size, limit in (
            ("shape", SHAPE_SIZE, 20.0),
            ("expression", EXPRESSION_SIZE, 50.0),
            *((joint, 3, 2 * np.pi) for joint in FIELDS.values()),
        ):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, checked(name, value, size, limit))
        if self.camera is not None:
            self.camera.check()

    def rotations(self) -> dict[str, NDArray[np.float32]]:
        """The rotations that were given, by the joint's name in JOINTS."""
        given = {joint: getattr(self, field) for joint, field in FIELDS.items()}
        return {joint: value for joint, value in given.items() if value is not None}


FIELDS = {joint: "global_rotation" if joint == "global" else joint for joint in JOINTS}


def resolve(
    source: Coefficients, source_camera: Camera, controls: Controls, arkit: ArkitMap
) -> tuple[Coefficients, Camera]:
    """Full coefficients and camera of the frame that ``controls`` asks for.

    Raises:
        CoefficientsError: an unknown ARKit name or a weight outside 0..1, or a sum out of range.
    """
    relative = controls.mode == "relative"
    rotations = controls.rotations()
    expression = controls.expression
    if controls.arkit is not None:
        units = arkit.to_coefficients(controls.arkit)
        base = np.zeros(EXPRESSION_SIZE, np.float32) if expression is None else expression
        expression = np.asarray(base) + units.expression
        for joint in ("jaw", "left_eye", "right_eye"):
            rotations.setdefault(joint, units.joint(joint))
    result = source
    if controls.shape is not None:
        result = replace(result, shape=_combined(source.shape, controls.shape, relative))
    if expression is not None:
        result = replace(result, expression=_combined(source.expression, expression, relative))
    if relative:
        rotations = {j: composed(r, source.joint(j)) for j, r in rotations.items()}
    return result.with_joints(rotations), controls.camera or source_camera


def composed(second: ArrayLike, first: ArrayLike) -> NDArray[np.float32]:
    """Axis-angle (3,) of rotating by ``first``, then by ``second``."""
    matrix = cv2.Rodrigues(np.asarray(second, np.float64))[0]
    matrix = matrix @ cv2.Rodrigues(np.asarray(first, np.float64))[0]
    return cv2.Rodrigues(matrix)[0].ravel().astype(np.float32)


def _combined(source: NDArray[np.float32], value: ArrayLike, relative: bool) -> NDArray[np.float32]:
    value = np.asarray(value, dtype=np.float32)
    return source + value if relative else value
