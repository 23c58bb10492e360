"""Which pixel of a mask is nearest, for every pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def nearest_pixels(known: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Row-major number of the nearest known pixel.

    Args:
        known: (h, w), True at least once.

    Returns:
        (h, w).
    """
    _, labels = cv2.distanceTransformWithLabels(
        (~known).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    pixel = np.empty(int(labels.max()) + 1, np.int64)
    pixel[labels[known]] = np.flatnonzero(known)
    return np.asarray(pixel[labels], np.int64)
