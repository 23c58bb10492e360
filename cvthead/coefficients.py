"""FLAME coefficients of one head in one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvthead.errors import CoefficientsError

Array = NDArray[np.float32]

SHAPE_SIZE = 100
EXPRESSION_SIZE = 50
JOINTS = ("global", "neck", "jaw", "left_eye", "right_eye")
POSE_SIZE = 3 * len(JOINTS)


def checked(name: str, values: ArrayLike, size: int, limit: float) -> Array:
    """``values`` as a read-only float32 vector of ``size`` finite numbers within +-``limit``.

    Raises:
        CoefficientsError: not numbers, wrong length, NaN or infinite, beyond the limit.
    """
    try:
        with np.errstate(over="ignore"):  # becomes infinite, which is refused below
            array = np.array(values, dtype=np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise CoefficientsError(
            f"{name} is not a list of numbers", hint=f"send {size} numbers"
        ) from error
    if array.shape != (size,):
        raise CoefficientsError(
            f"{name} has shape {list(array.shape)}, expected [{size}]", hint=f"send {size} numbers"
        )
    if not np.isfinite(array).all():
        raise CoefficientsError(
            f"{name} holds NaN or infinity at index {int(np.argmin(np.isfinite(array)))}",
            hint="send finite numbers",
        )
    if np.abs(array).max(initial=0) > limit:
        raise CoefficientsError(
            f"{name}[{int(np.abs(array).argmax())}] is beyond +-{limit:g}",
            hint=f"keep every value of {name} within +-{limit:g}",
        )
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class Coefficients:
    """Shape, expression and pose of a parametric head with FLAME's interface.

    Attributes:
        shape: (100,) identity, in standard deviations of the head model.
        expression: (50,) expression, in standard deviations.
        pose: (15,) axis-angle rotations in radians of the joints global (root), neck,
            jaw, left eye, right eye, in that order. Head space is right-handed:
            +x the subject's left, +y up, +z out of the face. A positive global y turns
            the head to the subject's left, a positive jaw x opens the mouth.

    Raises:
        CoefficientsError: on construction, for a wrong length, NaN or absurd values.
    """

    shape: Array
    expression: Array
    pose: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", checked("shape", self.shape, SHAPE_SIZE, 20.0))
        object.__setattr__(
            self, "expression", checked("expression", self.expression, EXPRESSION_SIZE, 50.0)
        )
        object.__setattr__(self, "pose", checked("pose", self.pose, POSE_SIZE, 2 * np.pi))

    @classmethod
    def zeros(cls) -> Coefficients:
        """The mean head, neutral, facing the camera."""
        return cls(np.zeros(SHAPE_SIZE), np.zeros(EXPRESSION_SIZE), np.zeros(POSE_SIZE))  # type: ignore[arg-type]

    def joint(self, name: str) -> Array:
        """Axis-angle (3,) of one of JOINTS."""
        start = 3 * JOINTS.index(name)
        return self.pose[start : start + 3]

    def with_joints(self, rotations: Mapping[str, ArrayLike]) -> Coefficients:
        """The same coefficients with the named joints' axis-angle rotations replaced."""
        pose = self.pose.copy()
        for name, rotation in rotations.items():
            start = 3 * JOINTS.index(name)
            pose[start : start + 3] = checked(name, rotation, 3, 2 * np.pi)
        return replace(self, pose=pose)
