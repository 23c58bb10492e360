"""``cvthead train``: one training run, described by a TOML file."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvthead.errors import InputError

if TYPE_CHECKING:
    from cvthead.training.config import TrainConfig

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
        "config",
        metavar="CONFIG",
        help="TOML file, or a shipped one: open-coarse, open, open-fine, finetune, paper, "
        "paper-stage2",
    )
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="instead of the file's")
    parser.add_argument(
        "--run", type=Path, dest="run_folder", metavar="FOLDER", help="instead of the file's"
    )
    parser.add_argument(
        "--init",
        metavar="WEIGHTS",
        help="start from a checkpoint.pt, a weights.safetensors, `shipped`, or `imported`",
    )
    add_set_option(parser)
    parser.add_argument(
        "--sitting", type=int, metavar="STEPS", help="stop after so many steps, to go on later"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    require(LIBRARIES)
    # PyTorch takes seconds to load and is not installed everywhere.
    from cvthead.training.train import train

    folders = {"data": args.data, "run": args.run_folder, "init": args.init}
    config = configuration(args, {k: v for k, v in folders.items() if v is not None})
    checkpoint = train(config, sitting=args.sitting)
    if os.environ.get("RANK", "0") == "0":  # under torchrun, one process speaks
        print(checkpoint)


def add_set_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="settings",
        metavar="KEY=VALUE",
        help="instead of the file's, for example steps=100 or losses.dice=0.5; repeat for several",
    )


def configuration(args: argparse.Namespace, given: Mapping[str, Any]) -> TrainConfig:
    """The file ``args.config`` with ``--set``, and ``given`` above both.

    Raises:
        InputError: as load_config and setting.
    """
    # Only training needs what is imported here.
    from cvthead.training.config import load_config, merged, setting

    values: dict[str, Any] = {}
    for text in args.settings:
        values = merged(values, setting(text))
    return load_config(args.config, merged(values, given))


def require(libraries: Sequence[str]) -> None:
    """Raises InputError if one is not installed."""
    for library in libraries:
        if find_spec(library) is None:
            raise InputError(
                f"training needs {library}", hint='install with pip install "cvthead[train]"'
            )
