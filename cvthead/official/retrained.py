"""Turn a training checkpoint of the preset official into a model folder of that preset.

    python -m cvthead.official.retrained RUN/checkpoint.pt MODEL

The folder is the import's with another CVTHead network: ``--model MODEL`` of the commands takes it.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
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
    WEIGHTS,
    Manifest,
    SourceFile,
    default_folder,
    file_sha256,
    write_manifest,
)
from cvthead.official.quantise import quantise
from cvthead.official.torch_networks import TorchNetworks
from cvthead.training.checkpoint import averaged, read

RETRAINED = "CVTHead, retrained"
# Files of the import that training does not touch.
KEPT = (*(name for name in WEIGHTS if name != NETWORK), PARSING_ONNX, HAIR_ONNX, DECA_ONNX)


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
        imported: folder of the import that the run took head and tables from.
        replace, eight_bit: as :func:`cvthead.official.importer.import_official`.

    Raises:
        InputError: not such a checkpoint, or ``output`` is there already or cannot be written.
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
    check_output(output, replace=replace)
    manifest = Manifest.load(imported)
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
        if eight_bit:  # calibrated on what the float networks paint
            psnr = quantise(temporary)
            write_manifest(temporary, sources, psnr, deformation=deformation)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--model", type=Path, metavar="FOLDER", help="import that it trained on")
    parser.add_argument("--replace", action="store_true", help="an earlier model gives way")
    parser.add_argument("--precision", choices=("int8", "float32"), default="int8")
    args = parser.parse_args(arguments)
    eight_bit = args.precision == "int8"
    imported = args.model or default_folder()
    export_retrained(
        args.checkpoint, args.output, imported, replace=args.replace, eight_bit=eight_bit
    )
    print(args.output)


if __name__ == "__main__":
    main()
