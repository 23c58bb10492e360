"""The first render, which is slow, done before the service says that it is ready."""

from __future__ import annotations

from io import BytesIO

import numpy as np
from PIL import Image

from cvthead.avatar import Avatar
from cvthead.camera import CROP_PIXELS, Camera, Crop
from cvthead.coefficients import Coefficients
from cvthead.deformation import Deformation
from cvthead.images import encode_image
from cvthead.pipeline import Pipeline


def warm_up(pipeline: Pipeline) -> None:
    """Render the bald head model without a portrait, and encode the picture."""
    encode_image(pipeline.render(nobody(pipeline)).rgba())


def nobody(pipeline: Pipeline) -> Avatar:
    """An avatar that fits the loaded model and shows no person."""
    grey = BytesIO()
    Image.new("RGB", (CROP_PIXELS, CROP_PIXELS), "grey").save(grey, "JPEG")
    return Avatar(
        np.zeros((pipeline.layout.surface, pipeline.networks.row_size), np.float16),
        np.ones(pipeline.layout.surface, np.bool_),
        np.zeros((CROP_PIXELS, CROP_PIXELS, 4), np.uint8),
        Deformation.none(pipeline.head),
        Coefficients.zeros(),
        Camera(5.5, 0.0, 0.0),
        Crop(0.0, 0.0, float(CROP_PIXELS)),
        grey.getvalue(),
        pipeline.preset,
        pipeline.fingerprint,
    )
