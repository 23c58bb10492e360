"""One-shot head avatars: encode a portrait once, render it from FLAME coefficients.

Example::

    from cvthead import Controls, Pipeline
    pipeline = Pipeline.load()
    avatar = pipeline.encode(image)
    frame = pipeline.render(avatar, Controls(arkit={"jawOpen": 0.5}))
"""

from cvthead.avatar import Avatar
from cvthead.camera import Camera, Crop
from cvthead.coefficients import Coefficients
from cvthead.controls import Controls
from cvthead.errors import CVTHeadError
from cvthead.frame import Frame
from cvthead.pipeline import Pipeline

__all__ = [
    "Avatar",
    "CVTHeadError",
    "Camera",
    "Coefficients",
    "Controls",
    "Crop",
    "Frame",
    "Pipeline",
]
