"""``cvthead train``: one training run, described by a TOML file."""

from __future__ import annotations

import argparse
import os
from importlib.util import find_spec
from pathlib import Path

from cvthead.errors import InputError

LIBRARIES = ("torch", "einops", "lightning_fabric", "tensorboard")


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "train",
        help="train or fine-tune the networks",
        description="Train as a configuration says, and go on where the run's checkpoint ends. "
        "Alone, or with several processes: torchrun --nproc-per-node N --no-python cvthead train "
        "CONFIG.",
    )
    parser.add_argument(
        "config", metavar="CONFIG", help="TOML file, or a shipped one: open, finetune, paper"
    )
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="instead of the file's")
    parser.add_argument(
        "--run", type=Path, dest="run_folder", metavar="FOLDER", help="instead of the file's"
    )
    parser.add_argument(
        "--init",
        metavar="WEIGHTS",
        help="start from a checkpoint.pt, a weights.safetensors, or `shipped`",
    )
    parser.add_argument(
        "--sitting", type=int, metavar="STEPS", help="stop after so many steps, to go on later"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    for library in LIBRARIES:
        if find_spec(library) is None:
            raise InputError(
                f"training needs {library}", hint='install with pip install "cvthead[train]"'
            )
    # PyTorch takes seconds to load and is not installed everywhere.
    from cvthead.training.config import load_config
    from cvthead.training.train import train

    given = {"data": args.data, "run": args.run_folder, "init": args.init}
    config = load_config(args.config, {k: v for k, v in given.items() if v is not None})
    checkpoint = train(config, sitting=args.sitting)
    if os.environ.get("RANK", "0") == "0":  # under torchrun, one process speaks
        print(checkpoint)
