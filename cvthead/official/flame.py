"""The user's FLAME (Li et al. 2017), from the released checkpoint or from FLAME's own file.

FLAME 2020 (``generic_model.pkl``) and FLAME 2023 (``flame2023.pkl``) have the same entries: the
first 300 columns of ``shapedirs`` are shape, the last 100 expression. Each may be a chumpy object
(as Python 2 wrote them in 2020), a sparse matrix or a plain array.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvthead.coefficients import EXPRESSION_SIZE, POSE_SIZE, SHAPE_SIZE
from cvthead.errors import AssetError
from cvthead.head.model import JOINT_COUNT, PARENTS, POSE_FEATURES, HeadModel, Region
from cvthead.official.keys import part
from cvthead.official.unpickle import HINT, load_npy, load_pickle

PREFIX = "deca.flame."
EXPRESSION_START = 300  # columns of shapedirs before it are shape
LANDMARKS = 68
FOREHEAD = 0.4  # height above the brows, as a share of that between chin and brows
# The released landmark file keeps the contour's tables as PyTorch tensors; nothing needs them.
UNUSED_TENSORS = frozenset({"torch._utils._rebuild_tensor_v2", "torch.storage._load_from_bytes"})

Array = NDArray[np.float32]
Ints = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Flame:
    """FLAME's tables as the package uses them; float32 and int32.

    Attributes:
        template, shape_basis, expression_basis, pose_basis, joint_regressor, weights, faces: as
            in HeadModel.
        landmark_faces, landmark_bary: (68,) and (68, 3): 17 of the jaw line, seen from the
            front, then the 51 inner landmarks.
        rest_pose: (15,) axis-angle of the joints that DECA does not estimate (neck, eyes).
    """

    template: Array
    shape_basis: Array
    expression_basis: Array
    pose_basis: Array
    joint_regressor: Array
    weights: Array
    faces: Ints
    landmark_faces: Ints
    landmark_bary: Array
    rest_pose: Array

    def __post_init__(self) -> None:
        shapes = part(PREFIX)
        vertices, faces = shapes["v_template"][0], shapes["faces_tensor"][0]
        expected = {
            "faces": (faces, 3),
            "landmark_faces": (LANDMARKS,),
            "landmark_bary": (LANDMARKS, 3),
            "rest_pose": (POSE_SIZE,),
            "template": (vertices, 3),
            "shape_basis": (vertices, 3, SHAPE_SIZE),
            "expression_basis": (vertices, 3, EXPRESSION_SIZE),
            "pose_basis": (POSE_FEATURES, 3 * vertices),
            "joint_regressor": (JOINT_COUNT, vertices),
            "weights": (vertices, JOINT_COUNT),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise AssetError(
                    f"FLAME: {name} has shape {getattr(self, name).shape}, not {shape}", hint=HINT
                )
        for name, count in (("faces", vertices), ("landmark_faces", faces)):
            table = getattr(self, name)
            if table.min() < 0 or table.max() >= count:
                raise AssetError(f"FLAME: {name} points outside 0..{count - 1}", hint=HINT)
        for field in fields(self):
            if not np.isfinite(getattr(self, field.name)).all():
                raise AssetError(f"FLAME: {field.name} holds NaN or infinity", hint=HINT)

    def head(self) -> HeadModel:
        """As a head model without landmarks of the 478 and other parts of the open head alone."""
        none = np.zeros((0, 3), np.float32)
        return HeadModel(
            template=self.template,
            shape_basis=self.shape_basis,
            expression_basis=self.expression_basis,
            pose_basis=self.pose_basis,
            joint_regressor=self.joint_regressor,
            weights=self.weights,
            faces=self.faces,
            uv=none[:, :2],
            uv_faces=none.astype(np.int32),
            region=self._regions(),
            landmark_faces=none[:, 0].astype(np.int32),
            landmark_bary=none,
            landmark_sigma=none[:, 0],
            mirror=none[:, 0].astype(np.int32),
            shape_parity=none[:, 0].astype(np.int8),
            expression_parity=none[:, 0].astype(np.int8),
        )

    def _regions(self) -> NDArray[np.uint8]:
        """(5023,) FACE between chin and hairline and in front of the ears, SCALP elsewhere.

        FLAME does not name its regions; crops are centred on the face.
        """
        landmarks = self.landmarks(self.template)
        low, high = landmarks.min(axis=0), landmarks.max(axis=0)
        high[1] += FOREHEAD * (high[1] - low[1])
        high[2] = np.inf
        face = ((self.template >= low) & (self.template <= high)).all(axis=1)
        return np.where(face, Region.FACE, Region.SCALP).astype(np.uint8)

    def landmarks(self, vertices: Array) -> Array:
        """(68, 3) landmarks on ``vertices`` (5023, 3)."""
        corners = vertices[self.faces[self.landmark_faces]]
        return np.asarray(np.einsum("lk,lkc->lc", self.landmark_bary, corners))

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def from_checkpoint(state: Mapping[str, NDArray[Any]]) -> Flame:
    """From the checkpoint's entries ``deca.flame.*``, without that prefix, checked for shape.

    Raises:
        AssetError: another skeleton.
    """
    _check_parents(state["parents"])
    neck, eyes = state["neck_pose"].reshape(3), state["eye_pose"].reshape(6)
    split = SHAPE_SIZE
    return Flame(
        template=_floats(state["v_template"]),
        shape_basis=_floats(state["shapedirs"][:, :, :split]),
        expression_basis=_floats(state["shapedirs"][:, :, split:]),
        pose_basis=_floats(state["posedirs"]),
        joint_regressor=_floats(state["J_regressor"]),
        weights=_floats(state["lbs_weights"]),
        faces=_indices(state["faces_tensor"]),
        landmark_faces=_indices(state["full_lmk_faces_idx"][0]),
        landmark_bary=_floats(state["full_lmk_bary_coords"][0]),
        rest_pose=_floats(np.concatenate([np.zeros(3), neck, np.zeros(3), eyes])),
    )


def from_files(model: Path, landmarks: Path) -> Flame:
    """From FLAME's model file and the released ``landmark_embedding.npy``.

    Raises:
        AssetError: unreadable, refused by the unpickler, or not these tables.
    """
    stored = load_pickle(model)
    embedding = load_npy(landmarks, ignored=UNUSED_TENSORS)
    try:
        _check_parents(np.asarray(stored["kintree_table"])[0])
        basis = _dense(stored["shapedirs"])
        poses = _dense(stored["posedirs"])
        if basis.shape[2] < EXPRESSION_START + EXPRESSION_SIZE or poses.shape[2] != POSE_FEATURES:
            raise ValueError(f"bases of shape {basis.shape} and {poses.shape}")
        stop = EXPRESSION_START + EXPRESSION_SIZE
        return Flame(
            template=_floats(_dense(stored["v_template"])),
            shape_basis=_floats(basis[:, :, :SHAPE_SIZE]),
            expression_basis=_floats(basis[:, :, EXPRESSION_START:stop]),
            pose_basis=_floats(poses.reshape(-1, POSE_FEATURES).T),
            joint_regressor=_floats(_dense(stored["J_regressor"])),
            weights=_floats(_dense(stored["weights"])),
            faces=_indices(_dense(stored["f"])),
            landmark_faces=_indices(embedding["full_lmk_faces_idx"][0]),
            landmark_bary=_floats(embedding["full_lmk_bary_coords"][0]),
            rest_pose=np.zeros(POSE_SIZE, np.float32),
        )
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise AssetError(
            f"{model} or {landmarks} is not FLAME's: {type(error).__name__} {error}", hint=HINT
        ) from error


def _check_parents(parents: NDArray[Any]) -> None:
    # The root's parent is stored as -1 or as the largest unsigned number.
    if tuple(np.asarray(parents).astype(np.int64)[1:]) != PARENTS[1:]:
        raise AssetError("FLAME: the joints are not global, neck, jaw and two eyes", hint=HINT)


def _dense(value: Any) -> NDArray[Any]:
    return np.asarray(value.toarray() if hasattr(value, "toarray") else value)


def _floats(value: NDArray[Any]) -> Array:
    return np.ascontiguousarray(value, dtype=np.float32)


def _indices(value: NDArray[Any]) -> Ints:
    return np.ascontiguousarray(value.astype(np.int64), dtype=np.int32)
