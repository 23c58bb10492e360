"""``cvthead import-official``: the released files become the official preset."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from cvthead.errors import InputError
from cvthead.files import write_errors
from cvthead.official.manifest import (
    EIGHT_BIT,
    LICENCES,
    MIN_PSNR,
    Manifest,
    default_folder,
)


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "import-official",
        help="import the files of the official CVTHead",
        description="Check the files of the official CVTHead release and convert them for "
        "--preset official. Nothing in them is run. Whoever imports them answers for their "
        "licences, which are printed.",
    )
    parser.add_argument(
        "folder",
        type=Path,
        metavar="DIR",
        help="folder with cvthead.pt, transform.pkl and the files that cvthead.pt lacks",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FOLDER",
        help=f"new folder for the converted model (default: {default_folder()})",
    )
    add_output_options(parser)
    parser.set_defaults(run=run)


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """How a model folder is written."""
    parser.add_argument(
        "--replace",
        action="store_true",
        help="an earlier model in that folder gives way once the new one is complete",
    )
    parser.add_argument(
        "--precision",
        choices=("int8", "float32"),
        default="int8",
        help="int8 (default) serves U-Net and image encoder in 8 bits where their pictures are "
        "close enough to the float ones; float32 serves everything as it was trained",
    )


def run(args: argparse.Namespace) -> None:
    for library in ("torch", "einops", "onnx", "onnxscript"):
        if find_spec(library) is None:
            raise InputError(
                f"importing needs {library}; the imported preset does not",
                hint='install with pip install "cvthead[train]"',
            )
    # PyTorch takes seconds to load and is not installed everywhere.
    from cvthead.official.importer import import_official

    output = args.output or default_folder()
    if args.output is None:
        with write_errors(output):
            output.parent.mkdir(parents=True, exist_ok=True)
    eight_bit = args.precision == "int8"
    for source in import_official(args.folder, output, replace=args.replace, eight_bit=eight_bit):
        print(f"{source.name}: {', '.join(source.used_for)}")
    print(f"\n{precisions(Manifest.load(output))}")
    print("\nLicences of what was imported; none of it is part of cvthead:")
    for licence in LICENCES:
        print(f"- {licence.part}: {licence.licence}; {licence.page}")
    print(f"\n{output}")


def precisions(model: Manifest) -> str:
    """Which networks of an import are served in 8 bits, and why."""
    if not model.psnr:
        return "everything is served in float32"
    lines = []
    for exact, small in EIGHT_BIT.items():
        served = f"it is served instead of {exact}"
        if small not in model.sha256:
            served = f"{MIN_PSNR:g} are wanted: {exact} is served"
        lines.append(f"{small}: pictures {model.psnr[small]:.1f} dB from the float ones; {served}")
    return "\n".join(lines)
