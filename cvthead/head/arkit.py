"""Apple's 52 ARKit blendshape weights as FLAME-style coefficients, and back.

jawOpen turns the jaw joint, the eight eyeLook units turn the eye joints, every other unit is a
direction in the expression space. All 52 have an effect; tongueOut moves the tongue only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from cvthead.coefficients import EXPRESSION_SIZE, POSE_SIZE, SHAPE_SIZE, Coefficients
from cvthead.errors import AssetError, CoefficientsError
from cvthead.head.model import ASSET, read_arrays

Array = NDArray[np.float32]

ARKIT_NAMES: tuple[str, ...] = (
    "browDownLeft",
    "browDownRight",
    "browInnerUp",
    "browOuterUpLeft",
    "browOuterUpRight",
    "cheekPuff",
    "cheekSquintLeft",
    "cheekSquintRight",
    "eyeBlinkLeft",
    "eyeBlinkRight",
    "eyeLookDownLeft",
    "eyeLookDownRight",
    "eyeLookInLeft",
    "eyeLookInRight",
    "eyeLookOutLeft",
    "eyeLookOutRight",
    "eyeLookUpLeft",
    "eyeLookUpRight",
    "eyeSquintLeft",
    "eyeSquintRight",
    "eyeWideLeft",
    "eyeWideRight",
    "jawForward",
    "jawLeft",
    "jawOpen",
    "jawRight",
    "mouthClose",
    "mouthDimpleLeft",
    "mouthDimpleRight",
    "mouthFrownLeft",
    "mouthFrownRight",
    "mouthFunnel",
    "mouthLeft",
    "mouthLowerDownLeft",
    "mouthLowerDownRight",
    "mouthPressLeft",
    "mouthPressRight",
    "mouthPucker",
    "mouthRight",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "mouthShrugUpper",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthStretchLeft",
    "mouthStretchRight",
    "mouthUpperUpLeft",
    "mouthUpperUpRight",
    "noseSneerLeft",
    "noseSneerRight",
    "tongueOut",
)

# Only these parts of the pose belong to face units.
_FACE_POSE = slice(6, POSE_SIZE)
# A joint rotates a lever of about this length, metres: makes radians comparable to vertices.
_LEVER = 0.05
# Weight of "no activation" against the fit; settles units that look alike.
_DAMPING = 1e-3


@dataclass(frozen=True, eq=False)
class ArkitMap:
    """The linear map from the units of ARKIT_NAMES to the open head's coefficients.

    Attributes:
        expression: (50, 52) coefficients of each unit at full strength.
        pose: (15, 52) axis-angle in radians of each unit at full strength.
        expression_scale: (50,) root mean square vertex motion of one standard deviation of each
            coefficient over the moving face, metres; compares coefficients in the inverse.
    """

    expression: Array
    pose: Array
    expression_scale: Array

    def __post_init__(self) -> None:
        units = len(ARKIT_NAMES)
        shapes = (self.expression.shape, self.pose.shape, self.expression_scale.shape)
        if shapes != ((EXPRESSION_SIZE, units), (POSE_SIZE, units), (EXPRESSION_SIZE,)):
            raise AssetError(
                f"ARKit map: arrays have shapes {shapes}", hint="build the open head again"
            )
        for array in (self.expression, self.pose, self.expression_scale):
            array.flags.writeable = False

    @classmethod
    def load(cls, path: Path | None = None) -> ArkitMap:
        """From the packaged open head, or another model file that holds ARKit arrays.

        Raises:
            AssetError: unreadable, or a model without ARKit units (a converted FLAME).
        """
        arrays = read_arrays(path, ASSET)
        names = ("arkit_names", "arkit_expression", "arkit_pose", "arkit_expression_scale")
        if any(n not in arrays for n in names) or (
            tuple(arrays["arkit_names"].tolist()) != ARKIT_NAMES
        ):
            raise AssetError(
                "this head model has no ARKit units", hint="use the packaged open head for ARKit"
            )
        return cls(*(arrays[n].astype(np.float32) for n in names[1:]))

    def to_coefficients(self, weights: Mapping[str, float]) -> Coefficients:
        """Coefficients of the mean identity with the given unit weights, each in 0..1.

        Units that are not named count as 0; the head itself is not turned.

        Raises:
            CoefficientsError: unknown name, not a number, NaN, or outside 0..1.
        """
        unit = np.zeros(len(ARKIT_NAMES), np.float32)
        for name, weight in weights.items():
            unit[_index(name)] = _checked_weight(name, weight)
        return Coefficients(
            np.zeros(SHAPE_SIZE, np.float32), self.expression @ unit, self.pose @ unit
        )

    def from_coefficients(self, coefficients: Coefficients) -> dict[str, float]:
        """Weights in 0..1 of all 52 units that come nearest to the expression, jaw and eyes.

        Bounded least squares. Exact for what one unit or a few units made; otherwise the nearest
        within the units' reach, since 50 coefficients and 9 angles do not always come from units.
        Shape, global and neck rotation have no part in it.
        """
        matrix = np.concatenate(
            [
                self.expression * self.expression_scale[:, None],
                self.pose[_FACE_POSE] * _LEVER,
                np.eye(len(ARKIT_NAMES), dtype=np.float32) * _DAMPING * self._damping_scale(),
            ]
        ).astype(np.float64)
        target = np.concatenate(
            [
                coefficients.expression * self.expression_scale,
                coefficients.pose[_FACE_POSE] * _LEVER,
                np.zeros(len(ARKIT_NAMES), np.float32),
            ]
        ).astype(np.float64)
        solution = lsq_linear(matrix, target, bounds=(0.0, 1.0), method="bvls").x
        return dict(zip(ARKIT_NAMES, solution.clip(0, 1).tolist(), strict=True))

    def _damping_scale(self) -> float:
        """Typical length of a unit's column, metres."""
        columns = np.linalg.norm(self.expression * self.expression_scale[:, None], axis=0)
        return float(np.median(columns[columns > 0]))


def _index(name: str) -> int:
    try:
        return ARKIT_NAMES.index(name)
    except ValueError as error:
        raise CoefficientsError(
            f"unknown ARKit blendshape {name!r}",
            hint="use Apple's camel-case names, such as jawOpen or mouthSmileLeft",
        ) from error


def _checked_weight(name: str, weight: float) -> float:
    hint = "send a number from 0 to 1"
    try:
        value = float(weight)
    except (TypeError, ValueError) as error:
        raise CoefficientsError(f"{name} is not a number", hint=hint) from error
    if not 0 <= value <= 1:  # also refuses NaN
        raise CoefficientsError(f"{name} is {value}, outside 0..1", hint=hint)
    return value
