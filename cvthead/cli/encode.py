"""``cvthead encode``: a portrait becomes an avatar file."""

from __future__ import annotations

import argparse
from pathlib import Path

from cvthead.cli.picture import check_output
from cvthead.cli.portrait import add_model_option, add_portrait_options
from cvthead.images import read_image
from cvthead.preset import load_preset


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "encode",
        help="turn a portrait into an avatar file",
        description="Turn a portrait into an avatar file, from which `cvthead render` and "
        "`cvthead animate` make pictures without looking at the portrait again.",
    )
    add_portrait_options(parser, "portrait", "PNG, JPEG or WebP picture of a face")
    add_model_option(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.avatar")
    parser.add_argument(
        "--only-one", action="store_true", help="refuse a portrait that shows several faces"
    )
    parser.add_argument(
        "--no-deformation",
        action="store_true",
        help="leave out hair and shoulders (for comparison)",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    check_output(args.output, (".avatar",), alpha=False)
    image = read_image(args.portrait)
    pipeline = load_preset(args.preset, model=args.model)
    avatar = pipeline.encode(
        image, face=args.face, only_one=args.only_one, deform=not args.no_deformation
    )
    avatar.save(args.output)
    print(args.output)
