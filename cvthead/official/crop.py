"""DECA's face crop and its camera, as the released code cuts and undoes them.

Pixel coordinates here are the released code's: the centre of the first pixel is 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS, Camera

DECA_PIXELS = 224
# The similarity maps the square's corner to the last pixel's centre, 223; normalised crop
# coordinates all the same span 224 pixels. DECA was trained so; both numbers stay.
DECA_CORNER = 223
ENLARGED, MARGIN = 1.1, 1.25

Array = NDArray[np.float32]


@dataclass(frozen=True)
class FaceSquare:
    """The square of a 256 x 256 picture that DECA sees: centre and side in its pixels."""

    x: float
    y: float
    size: float

    @classmethod
    def around(cls, landmarks: NDArray[np.floating]) -> FaceSquare:
        """From the (68, 2) landmarks' box.

        Args:
            landmarks: pixels of the 256 x 256 picture.
        """
        left, top = landmarks[:, :2].min(axis=0).astype(float)
        right, bottom = landmarks[:, :2].max(axis=0).astype(float)
        side = ((right - left) + (bottom - top)) / 2 * ENLARGED
        size = max(int(side * MARGIN), 1)
        return cls(right - (right - left) / 2, bottom - (bottom - top) / 2, float(size))

    @property
    def zoom(self) -> float:
        """Crop pixels per picture pixel."""
        return DECA_CORNER / self.size

    @property
    def corner(self) -> tuple[float, float]:
        return self.x - self.size / 2, self.y - self.size / 2

    @property
    def tform(self) -> Array:
        """(3, 3) similarity from picture to crop pixels, as the released code passes it on."""
        a, (left, top) = self.zoom, self.corner
        return np.array([[a, 0, -a * left], [0, a, -a * top], [0, 0, 1]], np.float32)

    def cut(self, picture: NDArray[np.uint8]) -> Array:
        """(256, 256, 3) uint8 RGB -> (3, 224, 224) in [0, 1], bilinear, 0 beyond the picture."""
        left, top = self.corner
        at = np.arange(DECA_PIXELS) / self.zoom
        rows = _bilinear(at + top, picture.shape[0])
        columns = _bilinear(at + left, picture.shape[1])
        scaled = picture.transpose(2, 0, 1) / 255.0
        return np.asarray(rows @ scaled @ columns.T, dtype=np.float32)

    def camera(self, cam: NDArray[np.floating]) -> Camera:
        """DECA's (scale, tx, ty) in the crop -> a camera in the picture's normalised coordinates.

        The released code projects into the crop and maps x and y back. The crop has no rotation,
        so the two steps are one camera. Its depth would be in another unit: see depth_ratio.
        """
        scale, tx, ty = (float(value) for value in cam)
        ratio = self.depth_ratio
        half = CROP_PIXELS / 2
        x, y = (((DECA_PIXELS / 2) / self.zoom + start) / half - 1 for start in self.corner)
        zoomed = scale / ratio
        return Camera(zoomed, tx + x / zoomed, ty - y / zoomed)

    @property
    def depth_ratio(self) -> float:
        """Depth that the network expects / depth of the camera of :meth:`camera`.

        The released code leaves depth in the crop's unit.
        """
        return self.zoom * CROP_PIXELS / DECA_PIXELS


def _bilinear(positions: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """(n, count) weights of the pixels around each position; pixels outside count as 0."""
    distance = np.abs(positions[:, None] - np.arange(count))
    return np.asarray(np.maximum(1 - distance, 0), dtype=np.float64)
