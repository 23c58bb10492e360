"""``cvthead render``: one picture of an avatar."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, get_args

import numpy as np

from cvthead.cli.motion_file import vector_controls
from cvthead.cli.picture import (
    IMAGE_FORMATS,
    add_picture_options,
    check_output,
    check_size,
    write_picture,
)
from cvthead.cli.portrait import add_model_option, add_preset_option, check_preset
from cvthead.cli.values import vector, weights
from cvthead.coefficients import Coefficients
from cvthead.composite import Composer
from cvthead.controls import FIELDS, Controls, Mode
from cvthead.preset import load_avatar, load_preset

FORMS = """\
Coefficients are written as all numbers (--jaw 0.3,0,0), as single ones (--expression
0=1.5,3=-2; the others keep the portrait's values, or 0 with --mode relative), or as a JSON file
with a list or an object (--shape shape.json, --shape @shape.txt). Options that are not given keep
the portrait's values. Rotations are axis-angle in radians: x opens the jaw or lowers the head,
y turns to the person's left, z tilts.
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "render",
        help="render one picture of an avatar",
        description="Render one picture of an avatar.",
        epilog=FORMS,
    )
    parser.add_argument("avatar", type=Path, metavar="FILE.avatar", help="from `cvthead encode`")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PICTURE")
    for name, what in (
        ("shape", "100 identity coefficients, standard deviations"),
        ("expression", "50 expression coefficients, standard deviations"),
        ("pose", "15 numbers: the five rotations below in this order"),
        ("global", "rotation of the whole head and shoulders (3)"),
        ("neck", "rotation of the head on the neck (3)"),
        ("jaw", "rotation of the jaw (3)"),
        ("left-eye", "rotation of the person's left eye (3)"),
        ("right-eye", "rotation of the person's right eye (3)"),
    ):
        parser.add_argument(f"--{name}", metavar="VALUES", help=what)
    parser.add_argument(
        "--arkit",
        metavar="NAME=WEIGHT,...",
        help="ARKit blendshapes, weights 0 to 1, for example mouthSmileLeft=0.8,jawOpen=0.3",
    )
    parser.add_argument(
        "--mode",
        choices=get_args(Mode),
        default="absolute",
        help="values replace the portrait's (absolute, the default) or are added to them",
    )
    add_preset_option(parser, default=None, shown="the avatar's")
    add_model_option(parser)
    add_picture_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    check_output(args.output, tuple(IMAGE_FORMATS), alpha=args.background == "transparent")
    check_size(args.size)
    avatar = load_avatar(args.avatar)
    if args.preset:
        check_preset(args.avatar, avatar, args.preset)
    controls = controls_of(args, avatar.coefficients)
    pipeline = load_preset(avatar.preset, model=args.model)
    composer = Composer.of(args.background, args.size, pipeline.background(avatar))
    frame = pipeline.render(avatar, controls)
    write_picture(args.output, composer.picture(frame), composer.source)
    print(args.output)


def controls_of(args: argparse.Namespace, source: Coefficients) -> Controls:
    """Controls from the options; ``source`` fills the indices that a sparse option leaves out.

    Raises:
        CoefficientsError: wrong length, NaN, out of range.
    """

    def start(values: np.ndarray) -> np.ndarray:
        return np.zeros_like(values) if args.mode == "relative" else values

    fields: dict[str, Any] = {}
    if args.pose is not None:
        fields |= vector_controls(vector("pose", args.pose, start(source.pose)))
    if args.shape is not None:
        fields["shape"] = vector("shape", args.shape, start(source.shape))
    if args.expression is not None:
        fields["expression"] = vector("expression", args.expression, start(source.expression))
    for joint, field in FIELDS.items():
        text = getattr(args, joint)
        if text is not None:
            fields[field] = vector(joint, text, start(source.joint(joint)))
    if args.arkit is not None:
        fields["arkit"] = weights("arkit", args.arkit)
    return Controls(**fields, mode=args.mode)
