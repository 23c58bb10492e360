"""``cvthead sweep``: one portrait under rising shape, expression, jaw and view coefficients."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from cvthead.camera import CROP_PIXELS, Camera
from cvthead.cli.picture import IMAGE_FORMATS, check_output, write_picture
from cvthead.cli.portrait import add_model_option, add_portrait_options, read_avatar
from cvthead.coefficients import EXPRESSION_SIZE, SHAPE_SIZE, Coefficients
from cvthead.composite import resampled
from cvthead.controls import Controls, resolve
from cvthead.crop import head_crop
from cvthead.errors import InputError
from cvthead.preset import AnyAvatar, Preset, load_preset
from cvthead.provenance import SourceType

MARGIN, CAPTION, TITLE = 8, 22, 128  # pixels; TITLE is the column of row names
FONT_SIZE = 15
WHITE, BLACK = (255, 255, 255), (20, 20, 20)


@dataclass(frozen=True)
class Row:
    """One coefficient over its range.

    Attributes:
        title: name.
        values: of the cells.
        caption: text below a cell.
        controls: of a value.
        centred: follow the face with the camera; a turned head would leave the picture.
    """

    title: str
    values: tuple[float, ...]
    caption: Callable[[float], str]
    controls: Callable[[float], Controls]
    centred: bool = False


STANDARD_DEVIATIONS = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)


def _along(name: str, size: int, index: int) -> Row:
    """One direction of shape or expression, as an offset from the portrait's own."""

    def controls(value: float) -> Controls:
        offset = np.zeros(size)
        offset[index] = value
        if name == "shape":
            return Controls(shape=offset, mode="relative")
        return Controls(expression=offset, mode="relative")

    return Row(f"{name} {index + 1}", STANDARD_DEVIATIONS, "{:+.0f} sd".format, controls)


ROWS = (
    _along("shape", SHAPE_SIZE, 0),
    _along("shape", SHAPE_SIZE, 1),
    _along("expression", EXPRESSION_SIZE, 0),
    _along("expression", EXPRESSION_SIZE, 1),
    Row(
        "jaw",
        (0.0, 0.06, 0.12, 0.18, 0.24, 0.3, 0.36),
        "{:.2f} rad".format,
        lambda value: Controls(jaw=(value, 0, 0)),
    ),
    Row(
        "view",
        (-60, -40, -20, 0, 20, 40, 60),
        "{:+.0f}°".format,
        lambda value: Controls(global_rotation=(0, np.radians(value), 0)),
        centred=True,
    ),
)


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "sweep",
        help="show what the coefficients do to a portrait",
        description="Write a grid of pictures: rows of shape, expression, jaw and view.",
    )
    add_portrait_options(parser, "portrait", "picture of a face, or an .avatar file")
    add_model_option(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PICTURE")
    parser.add_argument(
        "--cell", type=int, default=160, metavar="N", help="side of a cell in pixels (160)"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    check_output(args.output, tuple(IMAGE_FORMATS), alpha=False)
    if not 32 <= args.cell <= CROP_PIXELS:
        raise InputError(f"--cell {args.cell} is out of range", hint=f"use 32 to {CROP_PIXELS}")
    pipeline = load_preset(args.preset, model=args.model)
    avatar = read_avatar(pipeline, args.portrait, args.face)
    write_picture(args.output, grid(pipeline, avatar, args.cell), SourceType.GENERATED)
    print(args.output)


def grid(pipeline: Preset[Any], avatar: AnyAvatar, cell: int) -> NDArray[np.uint8]:
    """The labelled grid of ROWS on white, cells of ``cell`` pixels."""
    columns = max(len(row.values) for row in ROWS)
    step = cell + CAPTION + MARGIN
    size = TITLE + columns * (cell + MARGIN) + MARGIN, len(ROWS) * step + MARGIN
    sheet = Image.new("RGB", size, WHITE)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(FONT_SIZE)
    for number, row in enumerate(ROWS):
        top = MARGIN + number * step
        draw.text((MARGIN, top + cell // 2), row.title, BLACK, font, anchor="lm")
        for column, value in enumerate(row.values):
            left = TITLE + column * (cell + MARGIN)
            picture = resampled(_picture(pipeline, avatar, row, value), cell)
            sheet.paste(Image.fromarray(picture), (left, top))
            place = left + cell // 2, top + cell + CAPTION // 2
            draw.text(place, row.caption(value), BLACK, font, anchor="mm")
    return np.array(sheet)


def _picture(pipeline: Preset[Any], avatar: AnyAvatar, row: Row, value: float) -> NDArray[np.uint8]:
    coefficients, camera = resolve(
        avatar.coefficients, avatar.camera, row.controls(value), pipeline.arkit
    )
    if row.centred:
        camera = _centred(pipeline, coefficients, camera)
    return pipeline.render_coefficients(avatar, coefficients, camera).over(WHITE)


def _centred(pipeline: Preset[Any], coefficients: Coefficients, camera: Camera) -> Camera:
    """The camera moved so that the face lies where it lies in every source crop."""
    return camera.in_crop(head_crop(pipeline.head, coefficients, camera))
