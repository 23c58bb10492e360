"""What is behind the person, for frames that are shown over the portrait's own background."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS

MARGIN = 9
SMALL = CROP_PIXELS // 4

Image = NDArray[np.uint8]


def without_person(picture: Image, person: NDArray[np.bool_]) -> Image:
    """(256, 256, 3) picture with the person filled from the background around."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (MARGIN,) * 2)
    wide = cv2.dilate(person.astype(np.uint8), kernel)
    small = cv2.resize(picture, (SMALL, SMALL), interpolation=cv2.INTER_AREA)
    hole = cv2.resize(wide * 255, (SMALL, SMALL), interpolation=cv2.INTER_AREA) > 0
    filled = cv2.inpaint(small, hole.astype(np.uint8), 3, cv2.INPAINT_TELEA)
    filled = cv2.resize(filled, (CROP_PIXELS, CROP_PIXELS), interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(wide.astype(np.float32), (0, 0), 3)[..., None]
    soft = np.maximum(soft, wide[..., None])
    return np.asarray(picture * (1 - soft) + filled * soft, dtype=np.uint8)
