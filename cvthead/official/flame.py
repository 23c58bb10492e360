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
from cvthead.head.model import JOINT_COUNT, PARENTS, POSE_FEATURES, HeadModel, Region
from cvthead.official.keys import dense, part, refuse, table_problems
from cvthead.official.unpickle import load_npy, load_pickle, named_tables

PREFIX = "deca.flame."
EXPRESSION_START = 300  # columns of shapedirs before it are shape
LANDMARKS = 68
SKELETON = "the joints are not global, neck, jaw and two eyes"
FOREHEAD = 0.4  # height above the brows, as a share of that between chin and brows
# What the released code reads of FLAME's own file.
MODEL_SHAPES = {
    "f": (9976, 3),
    "v_template": (5023, 3),
    "shapedirs": (5023, 3, 400),
    "posedirs": (5023, 3, POSE_FEATURES),
    "J_regressor": (JOINT_COUNT, 5023),
    "weights": (5023, JOINT_COUNT),
    "kintree_table": (2, JOINT_COUNT),
}
LANDMARK_SHAPES = {
    "static_lmk_faces_idx": (51,),
    "static_lmk_bary_coords": (51, 3),
    "dynamic_lmk_faces_idx": (79, 17),
    "dynamic_lmk_bary_coords": (79, 17, 3),
    "full_lmk_faces_idx": (1, LANDMARKS),
    "full_lmk_bary_coords": (1, LANDMARKS, 3),
}
# The released landmark file keeps the contour's tables as PyTorch tensors; nothing needs them.
CONTOUR = ("dynamic_lmk_faces_idx", "dynamic_lmk_bary_coords")
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
        counts = {"faces": vertices, "landmark_faces": faces}
        refuse("FLAME", table_problems(self.arrays(), expected, counts).values())

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
        AssetError: another skeleton, NaN, or indices that point outside; names every entry.
    """
    shapes = part(PREFIX)
    vertices, faces = shapes["v_template"][0], shapes["faces_tensor"][0]
    counts = {"faces_tensor": vertices, "full_lmk_faces_idx": faces}
    problems = table_problems(state, shapes, counts)
    if "parents" not in problems and not _is_skeleton(state["parents"]):
        problems["parents"] = SKELETON
    refuse("FLAME in the checkpoint", problems.values())
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


def read_model(path: Path) -> dict[str, Any]:
    """The tables of FLAME's own file. What else it holds nothing needs.

    Raises:
        AssetError: unreadable, refused by the unpickler, or not these tables; names every entry.
    """
    stored = named_tables(path, load_pickle(path))
    vertices = MODEL_SHAPES["v_template"][0]
    problems = table_problems(stored, MODEL_SHAPES, {"f": vertices}, extra=True)
    if "kintree_table" not in problems and not _is_skeleton(dense(stored["kintree_table"])[0]):
        problems["kintree_table"] = SKELETON
    refuse(str(path), problems.values())
    return stored


def read_landmarks(path: Path) -> dict[str, Any]:
    """The tables of the released ``landmark_embedding.npy``, its PyTorch tensors as None.

    Raises:
        AssetError: as :func:`read_model`.
    """
    stored = named_tables(path, load_npy(path, ignored=UNUSED_TENSORS))
    tensors = {key for key in CONTOUR if key in stored and stored[key] is None}
    problems = table_problems(
        {key: table for key, table in stored.items() if key not in tensors},
        {key: shape for key, shape in LANDMARK_SHAPES.items() if key not in tensors},
        {"full_lmk_faces_idx": MODEL_SHAPES["f"][0]},
    )
    refuse(str(path), problems.values())
    return stored


def from_files(stored: Mapping[str, Any], embedding: Mapping[str, Any]) -> Flame:
    """From what :func:`read_model` and :func:`read_landmarks` gave."""
    basis, poses = dense(stored["shapedirs"]), dense(stored["posedirs"])
    stop = EXPRESSION_START + EXPRESSION_SIZE
    return Flame(
        template=_floats(dense(stored["v_template"])),
        shape_basis=_floats(basis[:, :, :SHAPE_SIZE]),
        expression_basis=_floats(basis[:, :, EXPRESSION_START:stop]),
        pose_basis=_floats(poses.reshape(-1, POSE_FEATURES).T),
        joint_regressor=_floats(dense(stored["J_regressor"])),
        weights=_floats(dense(stored["weights"])),
        faces=_indices(dense(stored["f"])),
        landmark_faces=_indices(embedding["full_lmk_faces_idx"][0]),
        landmark_bary=_floats(embedding["full_lmk_bary_coords"][0]),
        rest_pose=np.zeros(POSE_SIZE, np.float32),
    )


def _is_skeleton(parents: NDArray[Any]) -> bool:
    # The root's parent is stored as -1 or as the largest unsigned number.
    return tuple(parents.astype(np.int64)[1:]) == PARENTS[1:]


def _floats(value: NDArray[Any]) -> Array:
    return np.ascontiguousarray(value, dtype=np.float32)


def _indices(value: NDArray[Any]) -> Ints:
    return np.ascontiguousarray(value.astype(np.int64), dtype=np.int32)
