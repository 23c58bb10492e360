"""``cvthead data prepare``: videos and stills become training records."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from cvthead.cli.portrait import add_preset_option
from cvthead.data.layout import TEST, VAL
from cvthead.errors import InputError
from cvthead.official.manifest import default_folder
from cvthead.runtime.threads import cores


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("data", help="make training data")
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    prepare = actions.add_parser(
        "prepare",
        help="track, crop and mask videos and stills",
        description="Track the face in every video and still of a folder, cut 256 x 256 crops with "
        "masks, and write them as tar shards, split by identity. Goes on where an earlier call "
        "was interrupted.",
    )
    prepare.add_argument(
        "videos", type=Path, metavar="VIDEOS", help="folder; VoxCeleb's layouts are understood"
    )
    prepare.add_argument("out", type=Path, metavar="OUT", help="folder of the shards")
    prepare.add_argument(
        "--frames", type=int, default=30, metavar="N", help="per video (default: 30)"
    )
    prepare.add_argument(
        "--crop",
        choices=("head", "clip"),
        default="head",
        help="square around the head of each frame, as the renderer uses it, or one square per "
        "clip, as FOMM cuts (default: head)",
    )
    for split, share in (("val", VAL), ("test", TEST)):
        prepare.add_argument(
            f"--{split}",
            type=float,
            default=share,
            metavar="SHARE",
            help=f"of the identities for {split} (default: {share})",
        )
    prepare.add_argument(
        "--shard-size", type=int, default=256, metavar="N", help="records per shard"
    )
    prepare.add_argument(
        "--processes", type=int, default=cores(), metavar="N", help="default: one per core"
    )
    add_preset_option(prepare)
    prepare.add_argument(
        "--model", type=Path, metavar="FOLDER", help="of the preset official: another import"
    )
    prepare.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    if find_spec("webdataset") is None:
        raise InputError(
            "data preparation needs webdataset",
            hint='install with pip install "cvthead[train]"',
        )
    if min(args.frames, args.shard_size, args.processes) < 1:
        raise InputError(
            "--frames, --shard-size and --processes start at 1", hint="give a larger number"
        )
    # Only this command needs what is imported here.
    from cvthead.data.prepare import Settings, prepare

    model = None
    if args.preset == "official":
        model = args.model or default_folder()
    elif args.model:
        raise InputError("--model goes with --preset official", hint="leave it out, or add that")
    settings = Settings(args.val, args.test, args.frames, args.crop, args.shard_size)
    report = prepare(args.videos, args.out, settings, processes=args.processes, model=model)
    print(report.table())
    print(args.out)
