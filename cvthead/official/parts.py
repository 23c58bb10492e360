"""The parts of the released checkpoint that have files of their own, and how these are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from cvthead.errors import AssetError
from cvthead.model.bisenet import FaceParsing
from cvthead.official import torch_files
from cvthead.official.keys import check, deca_detail_shapes, part, released_shapes
from cvthead.official.unpickle import HINT

State = dict[str, Tensor]


@dataclass(frozen=True)
class Part:
    """A network or table that the checkpoint may hold, or a file of its own.

    Attributes:
        prefix: of its keys in the checkpoint.
        file: that has it otherwise.
        read: that file -> its tensors under the checkpoint's names.
    """

    prefix: str
    file: str
    read: Callable[[Path], State]


def _parsing(path: Path) -> State:
    prefix = "face_parsing.net."
    state = torch_files.load_state(path)
    check(str(path), state, part(prefix))
    normalisation = FaceParsing()
    return {
        "face_parsing.mean": normalisation.mean,
        "face_parsing.std": normalisation.std,
        **_prefixed(prefix, state),
    }


def _hair(path: Path) -> State:
    state = torch_files.load_state(path)
    check(str(path), state, part("hair_model."))
    return _prefixed("hair_model.", state)


def _deca(path: Path) -> State:
    """DECA's encoder. Its networks for details may be absent, for nothing needs them; what its
    training left in the file beside them is not looked at."""
    stored = torch_files.load(path)
    if not isinstance(stored, Mapping):
        raise AssetError(f"{path} holds no named networks", hint=HINT)
    expected = {f"E_flame.{key}": shape for key, shape in part("deca.E_flame.").items()}
    expected |= {
        key: shape for key, shape in deca_detail_shapes().items() if key.split(".")[0] in stored
    }
    networks = {key.split(".")[0] for key in expected}
    state: State = {}
    for name in networks.intersection(stored):
        tensors = torch_files.named_tensors(f"entry {name!r} of {path}", stored[name])
        state |= _prefixed(f"{name}.", tensors)
    check(str(path), state, expected)
    return {f"deca.{key}": value for key, value in state.items() if key.startswith("E_flame.")}


def _rome(path: Path) -> State:
    """ROME's image encoder; the file holds ROME's other networks too."""
    expected = part("autoencoder.")
    state = torch_files.load_state(path)
    named = {
        key.replace("autoencoder.", ""): value
        for key, value in state.items()
        if "autoencoder" in key
    }
    check(str(path), named, expected, extra=True)
    return _prefixed("autoencoder.", {key: named[key] for key in expected})


def _deform_mean(path: Path) -> State:
    state = {"deform_mean": torch_files.load_tensor(path)}
    check(str(path), state, {"deform_mean": released_shapes()["deform_mean"]})
    return state


def _deform_basis(path: Path) -> State:
    vertices, axes, size = released_shapes()["deform_basis"]
    state = {"deform_basis": torch_files.load_tensor(path)}
    check(str(path), state, {"deform_basis": (vertices * axes, size)})
    return {"deform_basis": state["deform_basis"].reshape(vertices, axes, size)}


def _prefixed(prefix: str, state: Mapping[str, Tensor]) -> State:
    return {prefix + key: value for key, value in state.items()}


PARTS = (
    Part("face_parsing.", "79999_iter.pth", _parsing),
    Part("hair_model.", "linear_hair.pth", _hair),
    Part("deca.E_flame.", "deca_model.tar", _deca),
    Part("autoencoder.", "rome.pth", _rome),
    Part("deform_mean", "mean_deform.pt", _deform_mean),
    Part("deform_basis", "u_full.pt", _deform_basis),
)
