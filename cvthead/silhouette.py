"""Binary silhouettes: of the person in the picture, and of the projected mesh.

All images here are square crops; points are continuous pixels, x right, y down, the centre of
the first pixel at 0.5.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.errors import FaceError

Mask = NDArray[np.bool_]
Points = NDArray[np.floating]

# fillConvexPoly takes fixed-point coordinates; 1/16 pixel is finer than any edge here.
_FRACTION_BITS = 4


def person_mask(
    probability: NDArray[np.floating], valid: Mask, face: Points, *, threshold: float = 0.5
) -> Mask:
    """The one connected region of the picture that holds the face.

    Args:
        probability: (S, S) in 0..1, output of the person segmentation.
        valid: (S, S), False where the crop lies beyond the picture.
        face: (P, 2) points on the face in pixels of the crop, for example the projected face
            vertices.
        threshold: probability above which a pixel is the person's.

    Returns:
        (S, S) bool.

    Raises:
        FaceError: no region of the person touches the face.
    """
    candidate = ((probability > threshold) & valid).astype(np.uint8)
    _, labels = cv2.connectedComponents(candidate, connectivity=4)
    inside, column, row = pixel_of(face, candidate.shape[0])
    votes = np.bincount(labels[row[inside], column[inside]], minlength=2)
    votes[0] = 0
    if votes.max() == 0:
        raise FaceError(
            "no person was found in the picture where the face is",
            hint="use a picture in which head and shoulders stand out from the background",
        )
    return np.asarray(labels == votes.argmax())


def pixel_of(points: Points, size: int) -> tuple[Mask, NDArray[np.intp], NDArray[np.intp]]:
    """Pixels under (P, 2) points: inside the picture (P,), column (P,), row (P,).

    Columns and rows are clamped to the picture, so they can always be used as indices.
    """
    cells = np.floor(points).astype(np.intp)
    inside = np.asarray(((cells >= 0) & (cells < size)).all(axis=1))
    cells = cells.clip(0, size - 1)
    return inside, cells[:, 0], cells[:, 1]


def rasterise(points: Points, faces: NDArray[np.integer], size: int) -> Mask:
    """Silhouette (size, size) of triangles (F, 3) over (N, 2) points.

    Only one orientation is drawn (counter-clockwise as seen, so clockwise with y down, which
    are the front faces of the heads used here): it covers the same area at half the cost.
    """
    # OpenCV counts pixel centres from 0.
    fixed = np.round((points - 0.5) * (1 << _FRACTION_BITS)).astype(np.int32)
    a, b, c = (fixed[faces[:, corner]] for corner in range(3))
    first, second = b - a, c - a
    front = first[:, 0] * second[:, 1] < first[:, 1] * second[:, 0]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    limit = size << _FRACTION_BITS
    seen = front & (low < limit).all(axis=1) & (high > 0).all(axis=1)
    image = np.zeros((size, size), dtype=np.uint8)
    for triangle in fixed[faces[seen]]:
        cv2.fillConvexPoly(image, triangle, 1, cv2.LINE_8, _FRACTION_BITS)
    return image.astype(bool)


def signed_distance(mask: Mask) -> NDArray[np.float32]:
    """Distance in pixels to the edge of the mask: positive inside, negative outside."""
    image = mask.astype(np.uint8)
    inner = cv2.distanceTransform(image, cv2.DIST_L2, 5)
    outer = cv2.distanceTransform(1 - image, cv2.DIST_L2, 5)
    return np.asarray(inner - outer, dtype=np.float32)


def distance_to_points(points: Points, size: int) -> NDArray[np.float32]:
    """(size, size) distance in pixels from each pixel to the nearest of (P, 2) points."""
    image = np.ones((size, size), dtype=np.uint8)
    inside, column, row = pixel_of(points, size)
    image[row[inside], column[inside]] = 0
    return np.asarray(cv2.distanceTransform(image, cv2.DIST_L2, 5), dtype=np.float32)


def overlap(first: Mask, second: Mask, valid: Mask) -> float:
    """Intersection over union of two masks within ``valid``; 0..1, 1 if both are empty there."""
    union = np.count_nonzero((first | second) & valid)
    return np.count_nonzero(first & second & valid) / union if union else 1.0
