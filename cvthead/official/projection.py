"""FLAME's vertices in the picture, as the released network takes them (paper section 3.2)."""

from __future__ import annotations

import numpy as np

from cvthead.camera import Camera
from cvthead.coefficients import Array, Coefficients
from cvthead.head.model import HeadModel
from cvthead.official.crop import FaceSquare


def project(
    head: HeadModel, coefficients: Coefficients, camera: Camera, offsets: Array, square: FaceSquare
) -> Array:
    """Posed vertices with hair and shoulders, projected: (5023, 3).

    Args:
        head: FLAME.
        coefficients: of FLAME.
        camera: in the 256 x 256 picture's normalised coordinates.
        offsets: (5023, 3) metres, added after posing, as in the released code.
        square: whose unit the depth is in.
    """
    points = camera.project(head.vertices(coefficients) + offsets)
    points[:, 2] *= np.float32(square.depth_ratio)
    return points
