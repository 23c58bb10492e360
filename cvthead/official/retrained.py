"""A training checkpoint of the preset official becomes a model folder of that preset: the import's
with another CVTHead network."""

from __future__ import annotations

import shutil
from pathlib import Path

from safetensors.torch import save_file

from cvthead.errors import InputError
from cvthead.files import atomic_path, write_errors
from cvthead.official.export import export_network
from cvthead.official.importer import check_output
from cvthead.official.manifest import (
    DECA_ONNX,
    HAIR_ONNX,
    NETWORK,
    PARSING_ONNX,
    TABLES,
    Manifest,
    SourceFile,
    file_sha256,
    write_manifest,
)
from cvthead.official.quantise import add_eight_bit
from cvthead.official.torch_networks import TorchNetworks
from cvthead.training.checkpoint import averaged, read

RETRAINED = "CVTHead, retrained"
# Files of the import that training does not touch.
KEPT = (*TABLES, PARSING_ONNX, HAIR_ONNX, DECA_ONNX)


def export_retrained(
    checkpoint: Path,
    output: Path,
    imported: Path,
    *,
    replace: bool = False,
    eight_bit: bool = True,
) -> None:
    """Write the averaged weights of a run as a model folder.

    Args:
        checkpoint: of a run of the preset official.
        output: new folder.
        imported: folder of the import that the run was made with, or of another network on the
            same.
        replace, eight_bit: as :func:`cvthead.official.importer.import_official`.

    Raises:
        InputError: not such a checkpoint, one of another import, or ``output`` is there already,
            is ``imported``, or cannot be written.
        AssetError: ``imported`` is none or is damaged, or an ONNX file differs from PyTorch.
    """
    contents = read(checkpoint)
    config = contents.get("config", {})
    preset, deformation = config.get("preset", "open"), config.get("deformation", True)
    if preset != "official":
        raise InputError(
            f"{checkpoint} is of the preset {preset}, not official",
            hint="`python -m cvthead.training.export` exports the open preset's",
        )
    manifest = Manifest.load(imported)
    if config["tables"] != manifest.tables_fingerprint:
        raise InputError(
            f"{checkpoint} was not trained with the import in {imported}",
            hint="name the import that made its records with --model",
        )
    if output.resolve() == imported.resolve():
        raise InputError(f"{output} is the import itself", hint="choose another folder")
    check_output(output, replace=replace)
    run = SourceFile(checkpoint.name, file_sha256(checkpoint), (RETRAINED,))
    sources = (*manifest.sources, run)
    new = atomic_path(output.resolve(), folder=True, replace=replace)
    with new as temporary, write_errors(output):
        for name in KEPT:
            shutil.copyfile(manifest.checked(name), temporary / name)
        state = {name: value.contiguous() for name, value in averaged(contents).items()}
        save_file(state, temporary / NETWORK)
        export_network(temporary, TorchNetworks.load(temporary))
        write_manifest(temporary, sources, deformation=deformation)
        if eight_bit:
            add_eight_bit(temporary)
