"""``cvthead export-official``: a training run becomes a model of the preset official."""

from __future__ import annotations

import argparse
from pathlib import Path

from cvthead.cli.import_official import add_output_options
from cvthead.cli.train import require
from cvthead.official.manifest import default_folder

LIBRARIES = ("torch", "einops", "lightning_fabric", "onnx", "onnxscript")


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "export-official",
        help="make a model folder of a retrained official network",
        description="Write the averaged weights of a run of the preset official as a model folder, "
        "for --preset official --model of the other commands.",
    )
    parser.add_argument("checkpoint", type=Path, metavar="CHECKPOINT", help="a run's checkpoint.pt")
    parser.add_argument("output", type=Path, metavar="OUT", help="new folder")
    parser.add_argument(
        "--model", type=Path, metavar="FOLDER", help="import that the run was made with"
    )
    add_output_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    require(LIBRARIES)
    # PyTorch takes seconds to load and is not installed everywhere.
    from cvthead.official.retrained import export_retrained

    imported = args.model or default_folder()
    eight_bit = args.precision == "int8"
    export_retrained(
        args.checkpoint, args.output, imported, replace=args.replace, eight_bit=eight_bit
    )
    print(args.output)
