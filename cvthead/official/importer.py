"""The released files become a folder that the official preset loads.

Everything is read as data (:mod:`cvthead.official.unpickle`, :mod:`.torch_files`) and checked
by name and shape before anything is written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from cvthead.errors import AssetError, InputError
from cvthead.files import atomic_path, write_errors
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.model.bisenet import AUXILIARY_HEADS, FaceParsing
from cvthead.model.official_keys import network_state
from cvthead.model.paper import PaperCVTHead
from cvthead.official import flame, torch_files
from cvthead.official.export import export_networks
from cvthead.official.keys import check, part, released_shapes
from cvthead.official.manifest import (
    DECA,
    EIGHT_BIT,
    FILES,
    FLAME,
    HAIR,
    MESH,
    NETWORK,
    PARSING,
    RECORD,
    SourceFile,
    file_sha256,
    write_manifest,
)
from cvthead.official.mesh import read_hierarchy
from cvthead.official.quantise import quantise

State = dict[str, Tensor]
Files = Mapping[str, Mapping[str, Tensor]]
CHECKPOINT = "cvthead.pt"
TABLES = "transform.pkl"
FLAME_NAMES = ("generic_model.pkl", "flame2023.pkl", "flame2023_Open.pkl")
LANDMARK_NAMES = ("landmark_embedding.npy",)
PLACES = "docs/official.md says where each official file comes from"


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
    state = torch_files.load_state(path, "E_flame")
    check(str(path), state, part("deca.E_flame."))
    return _prefixed("deca.E_flame.", state)


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


PARTS = (
    Part("face_parsing.", "79999_iter.pth", _parsing),
    Part("hair_model.", "linear_hair.pth", _hair),
    Part("deca.E_flame.", "deca_model.tar", _deca),
    Part("autoencoder.", "rome.pth", _rome),
    Part("deform_mean", "mean_deform.pt", _deform_mean),
    Part("deform_basis", "u_full.pt", _deform_basis),
)


@dataclass
class _Folder:
    """The user's folder; remembers what was taken from it."""

    path: Path
    used: dict[Path, list[str]] = field(default_factory=dict)

    def find(self, names: tuple[str, ...], purpose: str) -> Path:
        """The file of one of these names, at any depth, the least deep first."""
        found = [path for name in names for path in self.path.rglob(name) if path.is_file()]
        if not found:
            raise AssetError(
                f"{' or '.join(names)} is not in {self.path}; it is needed for {purpose}",
                hint=PLACES,
            )
        chosen = min(found, key=lambda path: (len(path.parts), str(path)))
        self.used.setdefault(chosen, []).append(purpose)
        return chosen

    def sources(self) -> tuple[SourceFile, ...]:
        return tuple(
            SourceFile(str(path.relative_to(self.path)), file_sha256(path), tuple(purposes))
            for path, purposes in self.used.items()
        )


def import_official(
    source: Path, output: Path, *, replace: bool = False, eight_bit: bool = True
) -> tuple[SourceFile, ...]:
    """Convert the released files.

    Args:
        source: folder with ``cvthead.pt``, ``transform.pkl`` and, for what the checkpoint does
            not hold, the separate files; they may lie in folders below it.
        output: new folder for safetensors and ONNX files and ``model.json``.
        replace: an earlier import in ``output`` gives way once the new one is complete; until
            then, and if anything fails, it stays as it was.
        eight_bit: False leaves out the 8-bit networks: everything is served in float32.

    Returns:
        The files that were used.

    Raises:
        InputError: ``source`` is no folder, ``output`` cannot be written or is there already
            (with ``replace``: holds anything but an import).
        AssetError: a file is missing, damaged, holds more than data, or its keys and shapes are
            not the released ones; lists them all. Or an ONNX file differs from PyTorch.
    """
    if not source.is_dir():
        raise InputError(f"{source} is not a folder", hint=PLACES)
    check_output(output, replace=replace)
    files, sources = read_release(source)
    # Resolved, for the folder that a link names is meant, not the link.
    new = atomic_path(output.resolve(), folder=True, replace=replace)
    with new as temporary, write_errors(output):
        write_model(temporary, files, sources)
        if eight_bit:  # calibrated on what the float networks paint
            write_manifest(temporary, sources, quantise(temporary))
    return sources


def read_release(source: Path) -> tuple[Files, tuple[SourceFile, ...]]:
    """Check the released files below ``source`` and convert them; writes nothing.

    Returns:
        File name -> tensors under the names of this package's modules, and the files used.

    Raises:
        AssetError: as :func:`import_official`.
    """
    folder = _Folder(source)
    state = _complete_state(folder)
    tables = _flame(folder, state)
    hierarchy = read_hierarchy(folder.find((TABLES,), "mesh hierarchy"))
    return _converted(state, tables, hierarchy), folder.sources()


def write_model(folder: Path, files: Files, sources: tuple[SourceFile, ...]) -> None:
    """Write weights, float32 networks and ``model.json`` into a folder that is there.

    Raises:
        AssetError: an ONNX file differs from PyTorch.
    """
    for name, tensors in files.items():
        save_file({key: value.contiguous() for key, value in tensors.items()}, folder / name)
    export_networks(folder)
    write_manifest(folder, sources)


def check_output(output: Path, *, replace: bool) -> None:
    """Refuse a folder that cannot be written before gigabytes are read, and never remove what is
    not an import.

    Raises:
        InputError: it holds other files than an import has; or, without ``replace``, any.
    """
    found = {path.name for path in output.iterdir()} if output.is_dir() else set()
    if found and not replace:
        raise InputError(
            f"{output} is already there", hint="replace it with --replace, or choose another -o"
        )
    if others := found - {*FILES, *EIGHT_BIT.values(), RECORD}:
        raise InputError(
            f"{output} holds more than an import: {', '.join(sorted(others)[:5])}",
            hint="choose another folder with -o",
        )


def _complete_state(folder: _Folder) -> State:
    """The checkpoint, with the parts it lacks taken from their own files."""
    path = folder.find((CHECKPOINT,), "CVTHead")
    state = torch_files.load_state(path, "model")
    absent = [p for p in PARTS if not any(key.startswith(p.prefix) for key in state)]
    lacking = tuple(p.prefix for p in absent)
    if not any(key.startswith(flame.PREFIX) for key in state):
        lacking += (flame.PREFIX,)
    expected = {k: s for k, s in released_shapes().items() if not k.startswith(lacking or ("\0",))}
    check(str(path), state, expected)
    for p in absent:
        state |= p.read(folder.find((p.file,), p.prefix.rstrip(".")))
    return state


def _flame(folder: _Folder, state: State) -> flame.Flame:
    tables = _cut(state, flame.PREFIX)
    if tables:
        return flame.from_checkpoint({key: value.numpy() for key, value in tables.items()})
    model = folder.find(FLAME_NAMES, "FLAME")
    return flame.from_files(model, folder.find(LANDMARK_NAMES, "FLAME's landmarks"))


def _converted(state: State, tables: flame.Flame, hierarchy: MeshHierarchy) -> Files:
    # Parameters without memory: only names and shapes are wanted.
    with torch.device("meta"):
        shapes = PaperCVTHead(hierarchy).state_dict()
    return {
        NETWORK: network_state(state, shapes),
        PARSING: {
            key: value
            for key, value in _cut(state, "face_parsing.").items()
            if not key.startswith(AUXILIARY_HEADS)
        },
        HAIR: {
            key: value
            for key, value in state.items()
            if key.startswith(("hair_model.", "deform_mean", "deform_basis"))
        },
        DECA: _cut(state, "deca.E_flame."),
        FLAME: {key: torch.from_numpy(np.array(a)) for key, a in tables.arrays().items()},
        MESH: mesh_tensors(hierarchy),
    }


def mesh_tensors(hierarchy: MeshHierarchy) -> State:
    """A hierarchy's tables under the names of :meth:`MeshHierarchy.load`."""
    tensors = {f"down_{k}": torch.from_numpy(table) for k, table in enumerate(hierarchy.down)}
    for k, (indices, weights) in enumerate(hierarchy.up):
        tensors[f"up_indices_{k}"] = torch.from_numpy(indices)
        tensors[f"up_weights_{k}"] = torch.from_numpy(weights)
    for k, table in enumerate(hierarchy.spirals):
        tensors[f"spirals_{k}"] = torch.from_numpy(table)
    return tensors


def _prefixed(prefix: str, state: Mapping[str, Tensor]) -> State:
    return {prefix + key: value for key, value in state.items()}


def _cut(state: Mapping[str, Tensor], prefix: str) -> State:
    return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
