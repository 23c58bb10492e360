"""What every command that writes pictures shares: background, size, file endings."""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS
from cvthead.errors import InputError
from cvthead.files import write_file
from cvthead.frame import Frame
from cvthead.images import ImageFormat, encode_image
from cvthead.provenance import SourceType

Colour = tuple[int, int, int]
Background = Colour | Literal["transparent", "source"]

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
        type=background,
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


def background(text: str) -> Background:
    """Parse ``--background``.

    Raises:
        InputError: none of the forms.
    """
    match text.lower():
        case "white":
            return 255, 255, 255
        case "transparent":
            return "transparent"
        case "source":
            return "source"
    digits = re.fullmatch(r"#([0-9a-fA-F]{2})([0-9a-fA-F]{2})([0-9a-fA-F]{2})", text)
    if digits is None:
        raise InputError(
            f"--background {text} is not known", hint="use white, #rrggbb, transparent or source"
        )
    red, green, blue = (int(value, 16) for value in digits.groups())
    return red, green, blue


@dataclass(frozen=True, eq=False)
class Composer:
    """Turns frames into pictures of the wanted background and size.

    Attributes:
        behind: a colour, an image (256, 256, 3) or None for transparent.
        size: side in pixels.
        source: what the AI-generated mark says.
    """

    behind: Colour | NDArray[np.uint8] | None
    size: int
    source: SourceType

    @classmethod
    def of(cls, choice: Background, size: int, portrait: NDArray[np.uint8]) -> Composer:
        """From the options.

        Args:
            portrait: (256, 256, 3) the portrait's own background.
        """
        if choice == "transparent":
            return cls(None, size, SourceType.GENERATED)
        if choice == "source":
            return cls(portrait, size, SourceType.COMPOSITE)
        return cls(choice, size, SourceType.GENERATED)

    def picture(self, frame: Frame) -> NDArray[np.uint8]:
        """(size, size, 3), or 4 channels when transparent."""
        if self.behind is not None:
            return resampled(frame.over(self.behind), self.size)
        if self.size == CROP_PIXELS:
            return frame.rgba()
        # Colours are meaningless where alpha is 0, so they must not be mixed in.
        alpha = frame.alpha[..., None].astype(np.float32) / 255
        layers = np.concatenate([frame.rgb * alpha, alpha * 255], axis=2)
        layers = _resize(layers, self.size)
        layers[..., :3] *= 255 / np.maximum(layers[..., 3:], 1)
        return _to_bytes(layers)


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


def resampled(image: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """A square picture at another size."""
    if image.shape[0] == size:
        return image
    return _to_bytes(_resize(image.astype(np.float32), size))


def _resize(image: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    # Area averaging keeps thin structures when shrinking, cubic stays sharp when enlarging.
    method = cv2.INTER_AREA if size < image.shape[0] else cv2.INTER_CUBIC
    return cv2.resize(image, (size, size), interpolation=method).astype(np.float32, copy=False)


def _to_bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(image).clip(0, 255).astype(np.uint8)
