"""What every command that writes pictures shares: background, size, file endings."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS
from cvthead.composite import Background, background
from cvthead.errors import InputError
from cvthead.files import write_file
from cvthead.images import ImageFormat, encode_image
from cvthead.provenance import SourceType

IMAGE_FORMATS: dict[str, ImageFormat] = {
    ".png": "png",
    ".jpg": "jpeg",
    ".jpeg": "jpeg",
    ".webp": "webp",
}
MIN_SIZE, MAX_SIZE = 16, 2048


def add_picture_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--background",
        type=background_option,
        default=(255, 255, 255),
        metavar="white|#rrggbb|transparent|source",
        help="behind the head: a colour (default: white), nothing, or the portrait's own "
        "background with the old head painted away",
    )
    parser.add_argument(
        "--size",
        type=int,
        default=CROP_PIXELS,
        metavar="N",
        help=f"side of the result in pixels; {CROP_PIXELS} is native and the default, other "
        "sizes are resampled from it and gain no detail",
    )


def background_option(text: str) -> Background:
    """``--background``; InputError names the option."""
    try:
        return background(text)
    except InputError as error:
        raise InputError(f"--{error}", hint=error.hint) from error


def check_size(size: int) -> None:
    if not MIN_SIZE <= size <= MAX_SIZE:
        raise InputError(f"--size {size} is out of range", hint=f"use {MIN_SIZE} to {MAX_SIZE}")


def check_output(path: Path, endings: tuple[str, ...], *, alpha: bool) -> None:
    """Refuse an output before any work is done for it.

    Args:
        endings: allowed file endings; "" is a folder.
        alpha: whether the picture is transparent.

    Raises:
        InputError: another ending, no such folder, or a format without transparency.
    """
    ending = path.suffix.lower()
    if ending not in endings:
        names = ", ".join(name or "no ending (a folder)" for name in endings)
        raise InputError(f"cannot write {path}: unknown ending {ending!r}", hint=f"use {names}")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent} is not a folder", hint="create the output's folder first")
    if alpha and ending in (".jpg", ".jpeg", ".mp4", ".gif"):
        raise InputError(
            f"{ending} files cannot be transparent", hint="use .png or another --background"
        )


def write_picture(path: Path, image: NDArray[np.uint8], source: SourceType) -> None:
    """Encode by the path's ending, with the AI-generated mark, and write it whole or not at all."""
    write_file(path, encode_image(image, IMAGE_FORMATS[path.suffix.lower()], source=source))
