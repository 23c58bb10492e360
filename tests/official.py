"""The reference run of the released code that lies beside the repository, as our objects.

Its weights are seeded stand-ins; see parity/README.md there.
"""

from __future__ import annotations

import importlib.util
import json
import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel

Arrays = dict[str, NDArray[Any]]


def arrays(shared: Path, name: str) -> Arrays:
    with np.load(shared / "reference" / "parity" / f"{name}.npz") as data:
        return dict(data)


def filler(shared: Path) -> ModuleType:
    path = shared / "reference" / "parity" / "filler.py"
    spec = importlib.util.spec_from_file_location("filler", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def transforms(shared: Path) -> dict[str, Any]:
    with (shared / "reference" / "official-data" / "transform.pkl").open("rb") as file:
        tables: dict[str, Any] = pickle.load(file, encoding="latin1")
    return tables


def hierarchy(shared: Path) -> MeshHierarchy:
    tables = transforms(shared)
    spirals = arrays(shared, "spirals")
    up = []
    for matrix in tables["up_transform"][:2]:
        rows = matrix.tocsr()
        up.append((rows.indices.reshape(-1, 3), rows.data.reshape(-1, 3)))
    down = tuple(m.tocsr().indices for m in tables["down_transform"][:2])
    return MeshHierarchy(
        down=down,
        up=tuple(up),
        spirals=tuple(spirals[f"level{k}"].astype(np.int32) for k in range(2)),
    )


def checkpoint(shared: Path) -> dict[str, Tensor]:
    """Seeded weights under the released names, without the parts fixed by data files."""
    keys = json.loads((shared / "reference" / "official-keys.json").read_text())["cvthead"]
    spec = {name: entry[:2] for part in keys.values() for name, entry in part.items()}
    state = {name: torch.from_numpy(v) for name, v in filler(shared).fill(spec).items()}
    state["pos_embedding"] = torch.from_numpy(arrays(shared, "sample_a")["pos_embedding"])[None]
    return state


def flame(shared: Path) -> HeadModel:
    """The stand-in for FLAME that the reference run used."""
    obj = (shared / "reference" / "official-data" / "head_template.obj").read_text()
    template = np.array([line.split()[1:] for line in obj.splitlines() if line.startswith("v ")])
    faces = transforms(shared)["face"][0]
    source = filler(shared).flame_standin(template.astype(np.float64), faces)
    none = np.zeros((0, 3), np.float32)
    return HeadModel(
        template=source["v_template"].astype(np.float32),
        shape_basis=source["shapedirs"][:, :, :100].astype(np.float32),
        expression_basis=source["shapedirs"][:, :, 300:350].astype(np.float32),
        pose_basis=source["posedirs"].reshape(-1, 36).T.astype(np.float32),
        joint_regressor=source["J_regressor"].astype(np.float32),
        weights=source["weights"].astype(np.float32),
        faces=source["f"].astype(np.int32),
        uv=none[:, :2],
        uv_faces=none.astype(np.int32),
        region=none[:, 0].astype(np.uint8),
        landmark_faces=none[:, 0].astype(np.int32),
        landmark_bary=none,
        landmark_sigma=none[:, 0],
        mirror=none[:, 0].astype(np.int32),
        shape_parity=none[:, 0].astype(np.int8),
        expression_parity=none[:, 0].astype(np.int8),
    )
