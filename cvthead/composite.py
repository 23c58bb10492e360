"""From a rendered frame to the picture that was asked for: background, then size."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS
from cvthead.errors import InputError
from cvthead.frame import Frame
from cvthead.provenance import SourceType

Colour = tuple[int, int, int]
Background = Colour | Literal["transparent", "source"]
FRINGE = np.ones((5, 5), np.uint8)  # two pixels to each side


def background(text: str) -> Background:
    """What ``white``, ``#rrggbb``, ``transparent`` or ``source`` means.

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
            f"background {text} is not known", hint="use white, #rrggbb, transparent or source"
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
        # Colours far from the person only make a file larger; those beside it keep whoever scales
        # the picture from a dark fringe.
        if self.size == CROP_PIXELS:
            beside = cv2.dilate(frame.alpha, FRINGE)
            drawn = np.asarray(cv2.copyTo(frame.rgb, beside), np.uint8)
            return Frame(drawn, frame.alpha).rgba()
        alpha = frame.alpha[..., None].astype(np.float32) / 255
        layers = np.concatenate([frame.rgb * alpha, alpha * 255], axis=2)
        layers = _resize(layers, self.size)
        layers[..., :3] *= 255 / np.maximum(layers[..., 3:], 1)
        return _to_bytes(layers)


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
