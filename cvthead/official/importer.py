"""The released files become a folder that the official preset loads.

Everything is read as data (:mod:`cvthead.official.unpickle`, :mod:`.torch_files`) and checked
by name and shape before anything is written.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from cvthead.errors import InputError
from cvthead.files import atomic_path, write_errors
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.model.bisenet import AUXILIARY_HEADS
from cvthead.model.official_keys import network_state
from cvthead.model.paper import PaperCVTHead
from cvthead.official import flame, torch_files
from cvthead.official.export import export_networks
from cvthead.official.keys import check, differences, part, released_shapes
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
    write_manifest,
)
from cvthead.official.mesh import read_hierarchy
from cvthead.official.parts import PARTS, State
from cvthead.official.quantise import add_eight_bit
from cvthead.official.release import PLACES, Release

Files = Mapping[str, Mapping[str, Tensor]]
CHECKPOINT = "cvthead.pt"
TABLES = "transform.pkl"
FLAME_NAMES = ("generic_model.pkl", "flame2023.pkl", "flame2023_Open.pkl")
LANDMARK_NAMES = ("landmark_embedding.npy",)


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
        if eight_bit:
            add_eight_bit(temporary)
    return sources


def read_release(source: Path) -> tuple[Files, tuple[SourceFile, ...]]:
    """Check the released files below ``source`` and convert them; writes nothing.

    Returns:
        File name -> tensors under the names of this package's modules, and the files used.

    Raises:
        AssetError: as :func:`import_official`.
    """
    release = Release(source)
    state = _complete_state(release)
    tables = _flame(release, state)
    hierarchy = release.read((TABLES,), "mesh hierarchy", read_hierarchy)
    release.refuse()
    assert state is not None
    assert tables is not None
    assert hierarchy is not None
    return _converted(state, tables, hierarchy), release.sources()


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
            f"{output} is already there", hint="replace it with --replace, or choose another folder"
        )
    if others := found - {*FILES, *EIGHT_BIT.values(), RECORD}:
        raise InputError(
            f"{output} holds more than an import: {', '.join(sorted(others)[:5])}",
            hint="choose another folder",
        )


def _complete_state(release: Release) -> State | None:
    """The checkpoint, with the parts it lacks taken from their own files.

    Returns:
        None if there is no readable checkpoint. What it holds is not known then, so of the
        separate files only those that are there are checked.
    """
    path = release.find((CHECKPOINT,), "CVTHead")
    stored = release.attempt(lambda: torch_files.load_state(path, "model")) if path else None
    state = stored or {}
    absent = [p for p in PARTS if not any(key.startswith(p.prefix) for key in state)]
    if stored is None:
        absent = [p for p in absent if release.has(p.file)]
    else:
        lacking = tuple(p.prefix for p in absent)
        if not any(key.startswith(flame.PREFIX) for key in state):
            lacking += (flame.PREFIX,)
        shapes = released_shapes().items()
        expected = {key: shape for key, shape in shapes if not key.startswith(lacking or ("\0",))}
        release.attempt(lambda: check(str(path), state, expected))
    for p in absent:
        state |= release.read((p.file,), p.prefix.rstrip("."), p.read) or {}
    return None if stored is None else state


def _flame(release: Release, state: State | None) -> flame.Flame | None:
    """None after a problem.

    Args:
        state: of :func:`_complete_state`.
    """
    tables = {key: value.numpy() for key, value in _cut(state or {}, flame.PREFIX).items()}
    if tables:
        fits = not differences(tables, part(flame.PREFIX))
        return release.attempt(lambda: flame.from_checkpoint(tables)) if fits else None
    read = (
        (FLAME_NAMES, "FLAME", flame.read_model),
        (LANDMARK_NAMES, "FLAME's landmarks", flame.read_landmarks),
    )
    model, landmarks = (
        release.read(names, purpose, reader) if state is not None or release.has(*names) else None
        for names, purpose, reader in read
    )
    return flame.from_files(model, landmarks) if model and landmarks else None


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


def _cut(state: Mapping[str, Tensor], prefix: str) -> State:
    return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
