"""From a tracked driving face to the coefficients and camera of the avatar's frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cvthead.avatar import Avatar
from cvthead.camera import Camera, Crop
from cvthead.coefficients import JOINTS, Coefficients
from cvthead.controls import composed
from cvthead.tracking.tracker import TrackedFace


def drive(
    avatar: Avatar,
    face: TrackedFace,
    *,
    reference: TrackedFace | None = None,
    crop: Crop | None = None,
) -> tuple[Coefficients, Camera]:
    """Expression and pose of the driver on the avatar's identity (paper equation 2).

    Args:
        avatar: whose shape, hair and descriptors are kept.
        face: the tracked driving frame.
        reference: a driving frame in which the driver looks as the source does. When given, the
            motion since it is added to the source's own expression and pose.
        crop: square of the driving picture that becomes the frame, so that the head also moves
            and grows as the driver's does. None keeps the source's camera.
    """
    source, driver = avatar.coefficients, face.coefficients
    expression, pose = driver.expression, driver.pose
    camera = avatar.camera if crop is None else face.camera.in_crop(crop)
    if reference is not None:
        start = reference.coefficients
        expression = source.expression + driver.expression - start.expression
        pose = np.concatenate(
            [composed(composed(driver.joint(j), -start.joint(j)), source.joint(j)) for j in JOINTS]
        )
        if crop is not None:
            camera = _moved(avatar.camera, reference.camera.in_crop(crop), camera)
    return replace(source, expression=expression, pose=pose), camera


def _moved(source: Camera, start: Camera, now: Camera) -> Camera:
    """The source's camera with the change of scale and place between two driving cameras."""
    return Camera(
        source.scale * now.scale / start.scale,
        source.tx + now.tx - start.tx,
        source.ty + now.ty - start.ty,
    )
