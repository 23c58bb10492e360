"""The turned square around a face that the landmark network looks at."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# MediaPipe's face graphs enlarge the longer side of the face's box by this much.
ENLARGEMENT = 1.5
MESH_POINTS = 468  # without the ten iris points
RIGHT_EYE_OUTER = 33
LEFT_EYE_OUTER = 263


@dataclass(frozen=True)
class FaceRegion:
    """A square of the image, turned so that the face in it is upright.

    Attributes:
        x, y: centre, continuous image pixels.
        size: side in pixels; above 0.
        angle: radians, positive clockwise on the screen (x right, y down); direction from the
            subject's right eye to the left one.
    """

    x: float
    y: float
    size: float
    angle: float

    def to_image(self, pixels: int) -> NDArray[np.float64]:
        """(2, 3) affine map: coordinates of a ``pixels`` wide cut -> image, both continuous."""
        zoom = self.size / pixels
        c, s = zoom * np.cos(self.angle), zoom * np.sin(self.angle)
        half = pixels / 2
        return np.array([[c, -s, self.x - half * (c - s)], [s, c, self.y - half * (s + c)]])

    def cut(self, image: NDArray[np.uint8], pixels: int) -> NDArray[np.uint8]:
        """Resample to (pixels, pixels, 3); the border is replicated beyond the image."""
        zoom = self.size / pixels
        shrink_x = shrink_y = 1.0
        left, top, part = self._covering(image)
        # Bilinear sampling alone aliases when it skips source pixels.
        if zoom > 1.5:
            height, width = part.shape[:2]
            size = max(1, round(width / zoom)), max(1, round(height / zoom))
            part = cv2.resize(part, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
            shrink_x, shrink_y = size[0] / width, size[1] / height
        matrix = self.to_image(pixels)
        matrix[:, 2] -= left, top
        matrix *= np.array([[shrink_x], [shrink_y]])
        # OpenCV counts from the centre of the first pixel, so shift both sides by half a pixel.
        matrix[:, 2] += 0.5 * (matrix[:, 0] + matrix[:, 1]) - 0.5
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cut = cv2.warpAffine(
            part, matrix, (pixels, pixels), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return cut.astype(np.uint8, copy=False)

    def _covering(self, image: NDArray[np.uint8]) -> tuple[int, int, NDArray[np.uint8]]:
        """Left, top and contents of the part of the image that the region can touch."""
        height, width = image.shape[:2]
        reach = self.size / 2 * (abs(np.cos(self.angle)) + abs(np.sin(self.angle)))
        margin = reach + 2 + self.size / 64
        left = int(np.clip(self.x - margin, 0, width - 1))
        top = int(np.clip(self.y - margin, 0, height - 1))
        right = int(np.clip(self.x + margin + 1, left + 1, width))
        bottom = int(np.clip(self.y + margin + 1, top + 1, height))
        return left, top, image[top:bottom, left:right]


def region_of_landmarks(landmarks: NDArray[np.floating]) -> FaceRegion:
    """Region for the next pass, from (478, 2 or more) landmarks in image pixels.

    Unlike MediaPipe's, the box is taken in the turned frame, so it does not grow with roll.
    """
    right, left = landmarks[RIGHT_EYE_OUTER, :2], landmarks[LEFT_EYE_OUTER, :2]
    angle = float(np.arctan2(left[1] - right[1], left[0] - right[0]))
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s], [-s, c]])
    upright = landmarks[:MESH_POINTS, :2] @ turn.T
    low, high = upright.min(axis=0), upright.max(axis=0)
    x, y = (low + high) / 2 @ turn
    return FaceRegion(float(x), float(y), float((high - low).max()) * ENLARGEMENT, angle)
