"""A parametric head with FLAME's interface: linear shape and expression, five joints, skinning.

Source: FLAME (Li et al. 2017) as the paper uses it (section 3.2). Head space is right-handed and
in metres: +x the subject's left, +y up, +z out of the face.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvthead.coefficients import EXPRESSION_SIZE, SHAPE_SIZE, Coefficients
from cvthead.errors import AssetError

Array = NDArray[np.float32]
Indices = NDArray[np.int32]

PARENTS = (-1, 0, 1, 1, 1)
JOINT_COUNT = len(PARENTS)
POSE_FEATURES = 9 * (JOINT_COUNT - 1)
ASSET = "open_head.npz"


class Region(IntEnum):
    """What a vertex belongs to. MOUTH is teeth and tongue, EYES the eyeballs."""

    SHOULDERS = 0
    NECK = 1
    SCALP = 2
    FACE = 3
    EYES = 4
    MOUTH = 5
    EARS = 6


@dataclass(frozen=True, eq=False)
class HeadModel:
    """The constants of one head topology and the functions that pose it.

    All arrays are float32 unless said otherwise. A model without landmarks, regions, mirror map
    or parities (a converted FLAME) carries them with length 0.

    Attributes:
        template: (N, 3) mean head, metres.
        shape_basis: (N, 3, 100) metres per standard deviation.
        expression_basis: (N, 3, 50) metres per standard deviation.
        pose_basis: (36, N * 3) displacement for each entry of R - I of joints 1 to 4.
        joint_regressor: (5, N), rows sum to 1.
        weights: (N, 5) skinning weights, rows sum to 1.
        faces: (F, 3) int32, counter-clockwise from outside.
        uv, uv_faces: (T, 2) and (F, 3) int32; v up.
        region: (N,) uint8, see Region.
        landmark_faces, landmark_bary, landmark_sigma: (478,) int32, (478, 3) and (478,) metres:
            where each face-mesh landmark sits and how well that is known (rms).
        mirror: (N,) int32, the vertex across the plane x = 0.
        shape_parity, expression_parity: (100,) and (50,) int8. Multiplying coefficients by them
            mirrors the head.
    """

    template: Array
    shape_basis: Array
    expression_basis: Array
    pose_basis: Array
    joint_regressor: Array
    weights: Array
    faces: Indices
    uv: Array
    uv_faces: Indices
    region: NDArray[np.uint8]
    landmark_faces: Indices
    landmark_bary: Array
    landmark_sigma: Array
    mirror: Indices
    shape_parity: NDArray[np.int8]
    expression_parity: NDArray[np.int8]

    def __post_init__(self) -> None:
        n = len(self.template)
        expected = {
            "template": (n, 3),
            "shape_basis": (n, 3, SHAPE_SIZE),
            "expression_basis": (n, 3, EXPRESSION_SIZE),
            "pose_basis": (POSE_FEATURES, 3 * n),
            "joint_regressor": (JOINT_COUNT, n),
            "weights": (n, JOINT_COUNT),
        }
        for name, shape in expected.items():
            found = getattr(self, name).shape
            if found != shape:
                raise AssetError(
                    f"head model: {name} has shape {found}, expected {shape}",
                    hint="build or convert the head model again",
                )
        for name in self.__dataclass_fields__:
            constant = np.ascontiguousarray(getattr(self, name)).view()
            constant.flags.writeable = False
            object.__setattr__(self, name, constant)

    @classmethod
    def load(cls, path: Path | None = None) -> HeadModel:
        """The packaged open head, or another model in the same format.

        Raises:
            AssetError: the file is missing, damaged or of another format.
        """
        arrays = read_arrays(path, ASSET)
        fields: dict[str, Any] = {}
        for name in cls.__dataclass_fields__:
            if name not in arrays:
                raise AssetError(
                    f"head model: {name} is missing", hint="build or convert the head model again"
                )
            value = arrays[name]
            fields[name] = value.astype(np.float32) if value.dtype.kind == "f" else value
        return cls(**fields)

    @cached_property
    def _identity(self) -> Callable[[bytes], Array]:
        """Shape coefficients' bytes -> (N * 3,) template + shape; remembered, because a driven
        head keeps its shape for many frames."""
        basis = self.shape_basis.reshape(-1, SHAPE_SIZE)

        @lru_cache(maxsize=8)
        def identity(shape: bytes) -> Array:
            return self.template.ravel() + basis @ np.frombuffer(shape, np.float32)

        return identity

    @cached_property
    def _corrected(self) -> slice | Indices:
        """Columns of pose_basis that any rotation moves."""
        moved = np.nonzero(self.pose_basis.any(axis=0))[0].astype(np.int32)
        return moved if len(moved) < 0.7 * self.pose_basis.shape[1] else slice(None)

    @cached_property
    def _corrective_basis(self) -> Array:
        return np.ascontiguousarray(self.pose_basis[:, self._corrected])

    def rest(self, coefficients: Coefficients) -> Array:
        """(N, 3) template + shape + expression, metres, before pose."""
        basis = self.expression_basis.reshape(-1, EXPRESSION_SIZE)
        moved = basis @ coefficients.expression
        moved += self._identity(coefficients.shape.tobytes())
        return moved.reshape(-1, 3)

    def joints(self, rest: Array) -> Array:
        """(5, 3) positions of global, neck, jaw, left and right eye joint in ``rest``."""
        return self.joint_regressor @ rest

    def transforms(self, pose: Array, joints: Array) -> Array:
        """(5, 3, 4) rigid transforms from rest to posed space.

        Args:
            pose: (15,) axis-angle of the five joints, radians.
            joints: (5, 3) their rest positions.
        """
        local = rotations(pose.reshape(JOINT_COUNT, 3))
        result = np.empty((JOINT_COUNT, 3, 4), np.float32)
        for joint, parent in enumerate(PARENTS):
            rotation = local[joint]
            shift = joints[joint] - rotation @ joints[joint]
            if parent >= 0:
                shift = result[parent, :, :3] @ shift + result[parent, :, 3]
                rotation = result[parent, :, :3] @ rotation
            result[joint, :, :3], result[joint, :, 3] = rotation, shift
        return result

    def pose_offsets(self, pose: Array) -> Array:
        """(N, 3) corrective displacements in rest space for a (15,) pose."""
        features = (
            rotations(pose.reshape(JOINT_COUNT, 3)[1:]) - np.eye(3, dtype=np.float32)
        ).ravel()
        offsets = np.zeros(self.pose_basis.shape[1], np.float32)
        if features.any():
            offsets[self._corrected] = features @ self._corrective_basis
        return offsets.reshape(-1, 3)

    def posed(
        self,
        coefficients: Coefficients,
        offsets: Array | None = None,
        extra: tuple[Indices, Array] | None = None,
    ) -> Array:
        """Posed vertices, metres.

        Args:
            offsets: (N, 3) displacements in rest space, such as hair; they turn with the head
                and do not move the joints.
            extra: (K,) anchor vertices and (K, 3) offsets from their (displaced) rest positions:
                further points that follow their anchors rigidly.

        Returns:
            (N, 3), or (N + K, 3) with ``extra``.
        """
        rest = self.rest(coefficients)
        transforms = self.transforms(coefficients.pose, self.joints(rest))
        rest += self.pose_offsets(coefficients.pose)
        if offsets is not None:
            rest += offsets
        if extra is None:
            return skin(rest, self.weights, transforms)
        anchors, shell = extra
        points = np.concatenate([rest, rest[anchors] + shell])
        return skin(points, np.concatenate([self.weights, self.weights[anchors]]), transforms)

    def vertices(self, coefficients: Coefficients) -> Array:
        """(N, 3) posed vertices, metres."""
        return self.posed(coefficients)

    def landmarks(self, vertices: Array) -> Array:
        """(478, 3) landmark positions on ``vertices`` (N, 3)."""
        corners = vertices[self.faces[self.landmark_faces]]
        return np.asarray(np.einsum("lk,lkc->lc", self.landmark_bary, corners))


def skin(points: Array, weights: Array, transforms: Array) -> Array:
    """Linear blend skinning: (M, 3) points, (M, J) weights, (J, 3, 4) transforms -> (M, 3)."""
    # One plane of M numbers per matrix entry: far faster than M small matrix products.
    entries = (transforms.reshape(len(transforms), 12).T @ weights.T).reshape(3, 4, -1)
    x, y, z = np.ascontiguousarray(points.T)
    posed = entries[:, 0] * x
    posed += entries[:, 1] * y
    posed += entries[:, 2] * z
    posed += entries[:, 3]
    return np.ascontiguousarray(posed.T)


def rotations(axis_angle: Array) -> Array:
    """(J, 3) axis-angle, radians -> (J, 3, 3), by Rodrigues' formula as FLAME's code has it.

    The angle is the norm of ``r + 1e-8``, so a zero vector is the identity.
    """
    angle = np.linalg.norm(axis_angle + np.float32(1e-8), axis=1)[:, None, None]
    x, y, z = (axis_angle / angle[:, :, 0]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    turned = np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    return np.asarray(np.eye(3, dtype=np.float32) + turned, dtype=np.float32)


def read_arrays(path: Path | None, packaged: str) -> dict[str, NDArray[np.generic]]:
    """Every array of an npz file without pickles: ``path``, or the packaged asset of that name.

    Raises:
        AssetError: missing or unreadable.
    """
    source = resources.files("cvthead").joinpath("assets", packaged) if path is None else path
    try:
        with source.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise AssetError(
            f"cannot read {source}: {error}", hint="reinstall cvthead, or check the given path"
        ) from error
