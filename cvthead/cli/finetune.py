"""``cvthead finetune``: one's own videos become a model folder, in one call."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cvthead.cli.portrait import add_preset_option
from cvthead.cli.train import add_set_option, configuration, require
from cvthead.errors import InputError
from cvthead.runtime.threads import cores

LIBRARIES = ("torch", "einops", "lightning_fabric", "tensorboard", "webdataset", "onnxscript")


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "finetune",
        help="fit the networks to your own videos",
        description="Prepare all videos and stills (official: videos alone) of a folder, train the "
        "preset's weights on them a little further, and write the result to OUT/model, for --model "
        "of the other commands. Called again, it goes on where it was interrupted.",
    )
    parser.add_argument(
        "videos", type=Path, metavar="VIDEOS", help="folder; one sub-folder per person"
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of records, run and model")
    add_preset_option(parser)
    parser.add_argument(
        "--config",
        default="finetune",
        metavar="CONFIG",
        help="TOML file instead of the shipped one, see docs/training.md",
    )
    add_set_option(parser)
    parser.add_argument(
        "--processes",
        type=int,
        default=cores(),
        metavar="N",
        help="of the preparation (default: one per core)",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    require(LIBRARIES)
    if args.processes < 1:
        raise InputError(f"--processes is {args.processes}", hint="use 1 or more")
    # PyTorch takes seconds to load and is not installed everywhere.
    from cvthead.data.prepare import Settings, prepare
    from cvthead.official.retrained import export_retrained
    from cvthead.training.export import export
    from cvthead.training.train import train

    records, model = args.out / "data" / "train", args.out / "model"
    given = {"data": records, "run": args.out / "run"}
    if args.preset == "official":
        given["preset"] = args.preset
        if not any(text.startswith("init=") for text in args.settings):
            given["init"] = "imported"
    config = configuration(args, given)
    if config.preset == "paper":
        raise InputError(
            f"the runtime does not know the preset {config.preset}",
            hint="use a configuration of another preset",
        )
    if config.preset != args.preset:
        raise InputError(
            f"the configuration is of the preset {config.preset}",
            hint=f"add --preset {config.preset}",
        )
    imported = config.imported if config.preset == "official" else None
    report = prepare(
        args.videos,
        args.out / "data",
        Settings(val=0, test=0),
        processes=args.processes,
        model=imported,
    )
    print(report.table())
    if not report.kept["train"]["records"]:
        raise InputError(
            f"none of the files in {args.videos} could be used",
            hint=f"{args.out / 'data' / 'report.json'} says why",
        )
    say(f"training, the losses are in {config.run / 'log.jsonl'} ...")
    checkpoint = train(config)
    say("exporting ...")
    if imported is None:
        export(checkpoint, model, records, {})
    else:
        export_retrained(checkpoint, model, imported, replace=True)
    print(model)


def say(text: str) -> None:
    """What goes on: each step takes minutes."""
    print(text, file=sys.stderr, flush=True)
