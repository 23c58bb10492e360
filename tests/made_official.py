"""A made-up official release: the released files' names, keys and shapes, seeded contents."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.spatial import Delaunay, cKDTree
from torch import Tensor

from cvthead.camera import Camera, Crop
from cvthead.coefficients import Coefficients
from cvthead.official.avatar import OfficialAvatar
from cvthead.official.crop import FaceSquare
from cvthead.official.flame import PREFIX, from_checkpoint
from cvthead.official.keys import deca_detail_shapes, released_shapes
from cvthead.official.manifest import FILES, write_manifest

Arrays = dict[str, NDArray[Any]]
State = dict[str, Tensor]
# Vertices and border vertices of the five levels; they give the released numbers of faces.
LEVELS = ((5023, 68), (1256, 46), (314, 29), (79, 17), (20, 4))
PARENTS = np.array([-1, 0, 1, 1, 1])


def surface(count: int, border: int) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """An open egg the size of a head: (count, 3) metres and 2 count - 2 - border triangles."""
    angle = np.arange(border) * 2 * np.pi / border
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inside = np.arange(count - border)
    # Within the polygon of the border.
    reach = min(0.98, np.cos(np.pi / border))
    radius, turn = np.sqrt((inside + 0.5) / len(inside)) * reach, inside * np.pi * (3 - np.sqrt(5))
    flat = np.concatenate([np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1), rim])
    faces = Delaunay(flat).simplices
    sides = flat[faces[:, 1:]] - flat[faces[:, :1]]
    clockwise = np.linalg.det(sides) < 0
    faces[clockwise] = faces[clockwise][:, ::-1]
    # Towards the viewer in the middle, the rim behind.
    height = np.sqrt(np.maximum(1 - (flat**2).sum(1), 0))
    points = np.stack([flat[:, 0] * 0.09, flat[:, 1] * 0.13, height * 0.1 - 0.03], axis=1)
    return points, faces.astype(np.uint32)


def tables() -> dict[str, list[Any]]:
    """The contents of ``transform.pkl``."""
    levels = [surface(*level) for level in LEVELS]
    down, up = [], []
    for (fine, _), (coarse, _) in pairwise(levels):
        _, chosen = cKDTree(fine).query(coarse)
        rows = np.arange(len(coarse))
        ones = np.ones(len(coarse), np.float32)
        down.append(csc_matrix((ones, (rows, chosen)), shape=(len(coarse), len(fine))))
        distance, near = cKDTree(coarse).query(fine, k=3)
        weights = 1 / (distance + 1e-3)
        weights /= weights.sum(1, keepdims=True)
        rows = np.repeat(np.arange(len(fine)), 3)
        entries = weights.ravel().astype(np.float32)
        up.append(csc_matrix((entries, (rows, near.ravel())), shape=(len(fine), len(coarse))))
    return {
        "vertices": [points for points, _ in levels],
        "face": [faces for _, faces in levels],
        "down_transform": down,
        "up_transform": up,
    }


def flame_state() -> Arrays:
    """The checkpoint's ``deca.flame.*`` without that prefix."""
    rng = np.random.default_rng(2)
    points, faces = surface(*LEVELS[0])
    n = len(points)
    joints = np.array([[0, -0.1, -0.02], [0, -0.06, -0.02], [0, -0.02, 0], [0.03, 0.03, 0.05]])
    joints = np.concatenate([joints, joints[3:] * [-1, 1, 1]])
    near = np.exp(-((points - joints[:, None]) ** 2).sum(-1) / 5e-4)
    return {
        "eye_pose": np.zeros((1, 6), np.float32),
        "neck_pose": np.zeros((1, 3), np.float32),
        "faces_tensor": faces.astype(np.int64),
        "v_template": points.astype(np.float32),
        "shapedirs": rng.normal(0, 1e-3, (n, 3, 150)).astype(np.float32),
        "posedirs": rng.normal(0, 1e-4, (36, 3 * n)).astype(np.float32),
        "J_regressor": (near / near.sum(1, keepdims=True)).astype(np.float32),
        "parents": PARENTS,
        "lbs_weights": (near / near.sum(0)).T.astype(np.float32),
        "lmk_faces_idx": np.arange(51),
        "lmk_bary_coords": np.full((51, 3), 1 / 3, np.float32),
        "dynamic_lmk_faces_idx": np.zeros((79, 17), np.int64),
        "dynamic_lmk_bary_coords": np.full((79, 17, 3), 1 / 3, np.float32),
        "full_lmk_faces_idx": (np.arange(68) * 100)[None],
        "full_lmk_bary_coords": np.full((1, 68, 3), 1 / 3, np.float32),
        "neck_kin_chain": np.array([1, 0]),
    }


def state() -> State:
    """A whole checkpoint; frames made with it are noise, but not constant."""
    generator = torch.Generator().manual_seed(3)
    fixed = {PREFIX + key: torch.from_numpy(np.array(a)) for key, a in flame_state().items()}
    result: State = {}
    for key, shape in released_shapes().items():
        if key in fixed:
            result[key] = fixed[key]
        elif key.endswith("num_batches_tracked"):
            result[key] = torch.zeros(shape, dtype=torch.int64)
        elif key.endswith("running_var") or (len(shape) == 1 and key.endswith(".weight")):
            result[key] = torch.ones(shape)
        elif len(shape) < 2:
            result[key] = torch.zeros(shape)
        else:
            fan_in = int(np.prod(shape[1:]))
            result[key] = torch.randn(shape, generator=generator) * (1.4 / fan_in**0.5)
    result["face_parsing.mean"] = torch.tensor([0.485, 0.456, 0.406])
    result["face_parsing.std"] = torch.tensor([0.229, 0.224, 0.225])
    result["deform_basis"] *= 1e-3
    result["hair_model.fc.weight"] *= 0.01
    result["deca.E_flame.layers.2.weight"] *= 0.01
    result["deca.E_flame.layers.2.bias"][206] = 8.0  # DECA's camera scale
    return result


def avatar() -> OfficialAvatar:
    """Of seeded numbers, for tests that render nothing."""
    rng = np.random.default_rng(4)
    return OfficialAvatar(
        rng.normal(size=(5023, 32)).astype(np.float32),
        rng.normal(size=(5023, 3)).astype(np.float32),
        Coefficients.zeros(),
        Camera(5.5, 0.01, -0.02),
        FaceSquare(130.0, 120.0, 150.0),
        Crop(3.0, 4.0, 200.0),
        rng.integers(0, 256, (256, 256, 3)).astype(np.uint8),
        "0123456789abcdef",
    )


def earlier_import(folder: Path) -> Path:
    """As the import writes it; what is in the files does not matter here."""
    folder.mkdir(parents=True)
    for name in FILES:
        (folder / name).write_bytes(b"earlier")
    write_manifest(folder, ())
    return folder


def write_whole(folder: Path, weights: State, mesh: dict[str, list[Any]]) -> None:
    """A release whose ``cvthead.pt`` holds everything."""
    checkpoint = {
        "model": weights,
        "epoch": 7,
        "loss_val_best": np.float64(0.25),
        "optimizer": {"state": {}, "param_groups": [{"lr": 1e-4}]},
    }
    torch.save(checkpoint, folder / "cvthead.pt")
    (folder / "data").mkdir()
    (folder / "data" / "transform.pkl").write_bytes(pickle.dumps(mesh, protocol=2))


def write_parts(folder: Path, weights: State, mesh: dict[str, list[Any]], flame: str) -> None:
    """A release in separate files, ``flame`` being the name of FLAME's."""
    data = folder / "data"
    data.mkdir()
    (data / "transform.pkl").write_bytes(pickle.dumps(mesh, protocol=2))
    moved = ("face_parsing.", "hair_model.", "deca.", "deform_")
    kept = {key: value for key, value in weights.items() if not key.startswith(moved)}
    torch.save({"model": kept}, folder / "cvthead.pt")
    torch.save(_cut(weights, "face_parsing.net."), folder / "79999_iter.pth")
    torch.save(_cut(weights, "hair_model."), folder / "linear_hair.pth")
    torch.save(deca(weights), folder / "deca_model.tar")
    torch.save(weights["deform_mean"], data / "mean_deform.pt")
    torch.save(weights["deform_basis"].reshape(-1, 60), data / "u_full.pt")
    tensors = {key: value.numpy() for key, value in _cut(weights, PREFIX).items()}
    write_flame(folder / flame, tensors, year=2020 if flame == "generic_model.pkl" else 2023)
    write_landmarks(data / "landmark_embedding.npy", tensors)


def deca(weights: State) -> dict[str, Any]:
    """The contents of ``deca_model.tar`` as DECA's trainer writes it."""
    networks: dict[str, Any] = {"E_flame": _cut(weights, "deca.E_flame.")}
    for key, shape in deca_detail_shapes().items():
        entry, name = key.split(".", 1)
        networks.setdefault(entry, {})[name] = torch.zeros(()).expand(shape)
    return networks | {"opt": {"state": {}, "param_groups": [{"lr": 1e-4}]}, "global_step": 5}


def write_landmarks(path: Path, tensors: Arrays) -> None:
    """``landmark_embedding.npy``, the contour's tables as PyTorch tensors like the released."""
    embedding = {
        "static_lmk_faces_idx": tensors["lmk_faces_idx"],
        "static_lmk_bary_coords": tensors["lmk_bary_coords"],
        "dynamic_lmk_faces_idx": torch.from_numpy(tensors["dynamic_lmk_faces_idx"]),
        "dynamic_lmk_bary_coords": torch.from_numpy(tensors["dynamic_lmk_bary_coords"]),
        "full_lmk_faces_idx": tensors["full_lmk_faces_idx"],
        "full_lmk_bary_coords": tensors["full_lmk_bary_coords"],
    }
    np.save(path, np.array(embedding, dtype=object), allow_pickle=True)


def write_flame(path: Path, tensors: Arrays, *, year: int) -> None:
    """FLAME's own file with 300 columns of shape and 100 of expression.

    Args:
        year: 2020 is written as by Python 2, arrays as chumpy objects and the joint regressor
            sparse; 2023 as by Python 3, plain arrays alone.
    """
    n = len(tensors["v_template"])
    tables = from_checkpoint(tensors)
    basis = np.zeros((n, 3, 400))
    basis[:, :, :100], basis[:, :, 300:350] = tables.shape_basis, tables.expression_basis
    regressor = tables.joint_regressor.astype(np.float64)
    joints = regressor @ tables.template
    arrays = {
        "v_template": tables.template.astype(np.float64),
        "shapedirs": basis,
        "posedirs": tables.pose_basis.T.reshape(n, 3, 36).astype(np.float64),
        "weights": tables.weights.astype(np.float64),
        "J": joints,
    }
    if year == 2023:
        parents = np.stack([PARENTS, np.arange(5)])
        stored = arrays | {"J_regressor": regressor, "kintree_table": parents}
        stored |= {"f": tables.faces.astype(np.int64), "bs_type": "lrotmin", "bs_style": "lbs"}
        path.write_bytes(pickle.dumps(stored, protocol=4))
        return
    parents = np.stack([PARENTS.astype(np.uint32), np.arange(5, dtype=np.uint32)])
    with chumpy() as wrap:
        stored = {name: wrap(value) for name, value in arrays.items()}
        stored |= {"J_regressor": csc_matrix(regressor), "kintree_table": parents}
        stored |= {"f": tables.faces.astype(np.uint32), "bs_type": "lrotmin", "bs_style": "lbs"}
        path.write_bytes(pickle.dumps(stored, protocol=2))


@contextmanager
def chumpy() -> Iterator[type]:
    """A class that pickles as ``chumpy.ch.Ch`` does, while the block lasts."""
    package, module = ModuleType("chumpy"), ModuleType("chumpy.ch")

    class Ch:
        def __init__(self, x: NDArray[Any]) -> None:
            # What chumpy keeps beside the array; its caches it leaves out.
            self._dirty_vars = {"x"}
            self._itr = None
            self._make_dense = self._make_sparse = False
            self._depends_on_deps: dict[str, object] = {}
            self.x = x

    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    module.Ch = Ch  # type: ignore[attr-defined]
    package.ch = module  # type: ignore[attr-defined]
    sys.modules |= {"chumpy": package, "chumpy.ch": module}
    try:
        yield Ch
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]


def _cut(weights: State, prefix: str) -> State:
    return {k.removeprefix(prefix): v.clone() for k, v in weights.items() if k.startswith(prefix)}
