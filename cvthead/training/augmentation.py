"""What training does to a sample's pictures, so that few people stand for many and a good
portrait for a poor one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.training.records import Frame

Array = NDArray[np.float32]

ZOOM, SHIFT = 0.07, 0.04  # jitter of the source crop, relative to its size
STRONG_COLOUR_SHARE = 0.4
DEGRADED_SHARE = 0.25
SMALLEST, LARGEST_BLUR, QUALITIES = 0.5, 1.2, (30, 95)  # scale, sigma in pixels, JPEG


def jittered(
    rng: np.random.Generator, source: Frame, points: Array
) -> tuple[NDArray[np.uint8], Array, Array]:
    """The source crop slightly zoomed and shifted: image, mask and points."""
    size = source.image.shape[0]
    zoom = float(rng.uniform(1 - ZOOM, 1 + ZOOM))
    shift = rng.uniform(-SHIFT, SHIFT, 2)
    centre = (size - 1) / 2
    offset = centre - zoom * centre + shift * size / 2
    matrix = np.array([[zoom, 0, offset[0]], [0, zoom, offset[1]]])
    image = cv2.warpAffine(source.image, matrix, (size, size), borderMode=cv2.BORDER_REPLICATE)
    mask = cv2.warpAffine(source.mask, matrix, (size, size))
    moved = points * np.float32(zoom)
    moved[:, :2] += shift.astype(np.float32)
    return image.astype(np.uint8), mask.astype(np.float32), moved


@dataclass(frozen=True)
class ColourJitter:
    """Affine change of colour: ``image @ matrix + offset``, clipped to 0..1."""

    matrix: Array
    offset: float

    def __call__(self, image: Array) -> Array:
        return np.asarray(np.clip(image @ self.matrix + np.float32(self.offset), 0, 1), np.float32)


UNCHANGED = ColourJitter(np.eye(3, dtype=np.float32), 0.0)


def colour_jitter(rng: np.random.Generator) -> ColourJitter:
    """One change of light, saturation and hue for all images of a sample.

    A part of the samples gets any hue at all: colours must be copied, not guessed from what
    people and clothes usually look like.
    """
    strong = rng.random() < STRONG_COLOUR_SHARE
    hue = rng.uniform(-np.pi, np.pi) if strong else rng.normal(0, 0.05)
    gain = rng.uniform(0.8, 1.15) * rng.uniform(0.94, 1.06, 3)
    # Rodrigues' rotation of RGB about the grey axis.
    axis = np.full(3, 3**-0.5)
    turn = cv2.Rodrigues(axis * hue)[0]
    grey = np.full((3, 3), 1 / 3)
    saturation = rng.uniform(0.75, 1.2)
    matrix = (grey + (np.eye(3) - grey) * saturation) @ turn * gain
    return ColourJitter(matrix.astype(np.float32), float(rng.uniform(-0.04, 0.06)))


def degraded(rng: np.random.Generator, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A part of the sources as a poor camera or a messenger gives them: fewer pixels, blurred,
    compressed. What they are compared with stays good.

    Args:
        image: (s, s, 3) uint8 RGB.
    """
    if rng.random() >= DEGRADED_SHARE:
        return image
    size = image.shape[0]
    small = round(size * rng.uniform(SMALLEST, 1))
    sigma, quality = rng.uniform(0.1, LARGEST_BLUR), int(rng.integers(*QUALITIES))
    poor = cv2.resize(image, (small, small), interpolation=cv2.INTER_AREA)
    poor = cv2.resize(poor, (size, size), interpolation=cv2.INTER_LINEAR)
    poor = cv2.GaussianBlur(poor, (0, 0), sigma)
    _, packed = cv2.imencode(".jpg", poor, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)
