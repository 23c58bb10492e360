"""``cvthead animate``: a portrait follows a driver."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cvthead.cli.driver import Drive, Options, open_driver
from cvthead.cli.picture import (
    IMAGE_FORMATS,
    add_picture_options,
    check_output,
    check_size,
    write_picture,
)
from cvthead.cli.portrait import add_model_option, add_portrait_options, read_avatar
from cvthead.composite import Composer
from cvthead.preset import AnyAvatar, Preset, load_preset
from cvthead.video_writer import video_writer

VIDEO_ENDINGS = (".mp4", ".gif", ".png", "")


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "animate",
        help="animate a portrait with a video, a picture or coefficients",
        description="Animate a portrait. A driving video's sound is kept in .mp4 files.",
    )
    add_portrait_options(parser, "portrait", "picture of a face, or an .avatar file")
    add_model_option(parser)
    parser.add_argument(
        "--driving",
        type=Path,
        required=True,
        metavar="VIDEO|IMAGE|COEFFS.json",
        help="whose motion to follow; examples/talk.json shows the form of a coefficient file",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUTPUT",
        help="out.mp4, out.gif, out.png (animated, or a still for a single frame), or frames/ "
        "(a folder of PNG files); for a single frame also .jpg and .webp",
    )
    parser.add_argument(
        "--camera",
        choices=("source", "driver"),
        default="source",
        help="keep the portrait's camera (default), or move and scale with the driver's head",
    )
    parser.add_argument(
        "--relative",
        action="store_true",
        help="add the motion since the driver's first frame to the portrait's own expression "
        "and pose, instead of copying the driver's; for coefficients: add them",
    )
    parser.add_argument(
        "--no-smoothing", action="store_true", help="do not filter the motion of a video"
    )
    add_picture_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    endings = tuple(dict.fromkeys([*VIDEO_ENDINGS, *IMAGE_FORMATS]))
    check_output(args.output, endings, alpha=args.background == "transparent")
    check_size(args.size)
    pipeline = load_preset(args.preset, model=args.model)
    avatar = read_avatar(pipeline, args.portrait, args.face)
    options = Options(args.relative, args.camera == "driver", not args.no_smoothing)
    drive = open_driver(args.driving, pipeline, avatar, options)
    composer = Composer.of(args.background, args.size, pipeline.background(avatar))
    if drive.count == 1 and args.output.suffix.lower() in IMAGE_FORMATS:
        # All of them, for a video whose only frame shows no face says so after it.
        step = list(drive.steps)[0]  # noqa: RUF015
        frame = pipeline.render_coefficients(avatar, step.coefficients, step.camera)
        write_picture(args.output, composer.picture(frame), composer.source)
    else:
        check_output(args.output, VIDEO_ENDINGS, alpha=False)
        _write_video(args.output, pipeline, avatar, drive, composer)
    print(args.output)


def _write_video(
    path: Path, pipeline: Preset[Any], avatar: AnyAvatar, drive: Drive, composer: Composer
) -> None:
    with video_writer(
        path,
        size=(composer.size, composer.size),
        fps=drive.fps,
        audio_from=drive.audio,
        source=composer.source,
    ) as write:
        latest = -1.0
        # disable=None: no bar where nobody watches, such as in a log file.
        for step in tqdm(drive.steps, "animate", drive.count or None, unit="frame", disable=None):
            if step.time <= latest:  # broken videos repeat time stamps
                continue
            latest = step.time
            frame = pipeline.render_coefficients(avatar, step.coefficients, step.camera)
            write(composer.picture(frame), step.time)
