"""Weak-perspective camera and the square crop that the networks see.

Image coordinates are continuous: x right, y down, pixel i covers [i, i + 1), so the centre of
the first pixel is 0.5. Normalised crop coordinates run from -1 to 1 over the crop's edges.
Depth has the unit of x and y; smaller is nearer to the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.coefficients import checked
from cvthead.errors import CoefficientsError

CROP_PIXELS = 256
# Far beyond any picture, and far from where float32 projections overflow.
CAMERA_LIMIT = 1e6


@dataclass(frozen=True)
class Camera:
    """Orthographic projection with one scale (paper section 3.2, DECA's camera).

    ``x = scale (X + tx)``, ``y = -scale (Y + ty)``, ``depth = -scale Z``.

    Attributes:
        scale: image units (pixels, or normalised crop units) per metre; above 0.
        tx, ty: translation in metres, applied before the scale.
    """

    scale: float
    tx: float
    ty: float

    def check(self) -> None:
        """Refuse a camera that cannot project.

        Raises:
            CoefficientsError: NaN, infinite, beyond +-CAMERA_LIMIT, or a scale not above 0.
        """
        scale = checked("camera", (self.scale, self.tx, self.ty), 3, CAMERA_LIMIT)[0]
        if scale <= 0:
            raise CoefficientsError(f"camera has scale {self.scale:g}", hint="use one above 0")

    def project(self, vertices: NDArray[np.floating]) -> NDArray[np.float32]:
        """(..., 3) head-model vertices in metres -> (..., 3) image x, y and depth."""
        shift = np.array([self.tx, self.ty, 0.0], dtype=np.float32)
        flip = np.array([1.0, -1.0, -1.0], dtype=np.float32) * np.float32(self.scale)
        return ((vertices + shift) * flip).astype(np.float32, copy=False)

    def in_crop(self, crop: Crop) -> Camera:
        """This camera (in image pixels) expressed in the crop's normalised coordinates."""
        scale = self.scale * 2 / crop.size
        return Camera(
            scale,
            self.tx - (2 * crop.left / crop.size + 1) / scale,
            self.ty + (2 * crop.top / crop.size + 1) / scale,
        )


@dataclass(frozen=True)
class Crop:
    """An axis-aligned square of an image, in pixels; may reach beyond the image."""

    left: float
    top: float
    size: float

    def cut(
        self, image: NDArray[np.uint8], pixels: int = CROP_PIXELS
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Resample to ``pixels`` x ``pixels``.

        Returns:
            The crop, (pixels, pixels[, channels]) with the border replicated beyond the image,
            and its validity mask (pixels, pixels), False beyond the image.
        """
        zoom = pixels / self.size
        # Shrinking by warpAffine alone aliases, so shrink the covered part first.
        if zoom < 0.75:
            height, width = image.shape[:2]
            # A whole size, not fx and fy: given those, resize scales by them exactly, which is
            # not the ratio of the sizes, and the far side of a large picture shifts by a pixel.
            small = max(1, round(width * zoom)), max(1, round(height * zoom))
            image_small = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
            fx, fy = small[0] / width, small[1] / height
        else:
            image_small, fx, fy = image, 1.0, 1.0
        zx, zy = zoom / fx, zoom / fy
        # Pixel centres are at +0.5, warpAffine counts them from 0.
        matrix = np.array(
            [
                [zx, 0, zx * (0.5 - self.left * fx) - 0.5],
                [0, zy, zy * (0.5 - self.top * fy) - 0.5],
            ]
        )
        size = (pixels, pixels)
        crop = cv2.warpAffine(
            image_small, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        valid = self.inside(image.shape[0], image.shape[1], pixels)
        return crop.astype(np.uint8, copy=False), valid

    def inside(self, height: int, width: int, pixels: int = CROP_PIXELS) -> NDArray[np.bool_]:
        """(pixels, pixels) of the resampled crop, False beyond an image of this size."""
        centres = (np.arange(pixels) + 0.5) / (pixels / self.size)
        x, y = self.left + centres, self.top + centres
        return ((y >= 0) & (y <= height))[:, None] & ((x >= 0) & (x <= width))
