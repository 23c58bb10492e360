"""The square crop around a head that the renderer works in."""

from __future__ import annotations

import numpy as np

from cvthead.camera import Camera, Crop
from cvthead.coefficients import Coefficients
from cvthead.errors import AssetError
from cvthead.head.model import HeadModel, Region

# Side of the crop in metres on the head: room for hair and the upper shoulders.
CROP_METRES = 0.36
# Where the centre of the face lies in the crop, as shares of its side from left and top.
FACE_AT = (0.50, 0.46)


def head_crop(head: HeadModel, coefficients: Coefficients, camera: Camera) -> Crop:
    """A square of CROP_METRES whose point FACE_AT is the centre of the projected face's box.

    Args:
        coefficients, camera: a tracked face, for example; the camera in image pixels.

    Returns:
        The crop in image pixels; may reach beyond the image.

    Raises:
        AssetError: the head model does not say which vertices are its face.
    """
    if len(head.region) == 0:
        raise AssetError(
            "the head model has no regions", hint="Label the converted model's vertices first."
        )
    face = head.vertices(coefficients)[head.region == Region.FACE]
    points = camera.project(face)[:, :2]
    x, y = (points.min(axis=0) + points.max(axis=0)) / np.float32(2)
    size = CROP_METRES * camera.scale
    return Crop(float(x - FACE_AT[0] * size), float(y - FACE_AT[1] * size), size)
