"""Values of mesh vertices, interpolated over the front triangles by OpenCV's rasteriser."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

# OpenCV knows perspective cameras only. This far away one is as good as parallel.
DISTANCE, FIELD = 50.0, 0.5
HALF = np.float32(math.tan(FIELD / 2))
IDENTITY = np.eye(4, dtype=np.float32)
FAR = 10.0  # depth of pixels that no triangle covers; no point is that far


def rasterise(
    points: Array, faces: NDArray[np.int32], values: Array, size: int
) -> tuple[Array, Array]:
    """Draw triangles that face the camera, the nearest in front.

    Args:
        points: (N, 3) normalised projections, depth within -10..10.
        faces: (F, 3), counter-clockwise from outside.
        values: (N, 3) of each vertex, 0..1.
        size: image height and width.

    Returns:
        Interpolated values (size, size, 3), 0 where empty, and depth (size, size), FAR there
        to about 1e-4.
    """
    away = np.float32(DISTANCE) + points[:, 2]
    # Placed so that the perspective camera sees each vertex exactly where it is projected.
    vertices = np.empty_like(points)
    vertices[:, 0] = points[:, 0] * away * HALF
    vertices[:, 1] = -points[:, 1] * away * HALF
    vertices[:, 2] = -away
    image = np.zeros((size, size, 3), np.float32)
    depth = np.full((size, size), DISTANCE + FAR, np.float32)
    settings = cv2.TriangleRasterizeSettings()
    settings.setCullingMode(cv2.RASTERIZE_CULLING_CW)
    settings.setShadingType(cv2.RASTERIZE_SHADING_SHADED)
    cv2.triangleRasterize(
        vertices, faces, values, image, depth, IDENTITY, FIELD, 1.0, DISTANCE + FAR, settings
    )
    depth -= np.float32(DISTANCE)
    return image, depth
