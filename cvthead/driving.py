"""From a tracked driving face to the coefficients and camera of the avatar's frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvthead.camera import Camera, Crop
from cvthead.coefficients import JOINTS, Coefficients
from cvthead.controls import composed
from cvthead.head.model import HeadModel, Region
from cvthead.tracking.tracker import TrackedFace

HEAD = JOINTS.index("neck")  # the joint that carries the skull


class Driven(Protocol):
    """The part of an avatar, of any preset, that driving needs."""

    @property
    def coefficients(self) -> Coefficients: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def preset(self) -> str: ...


@dataclass(frozen=True, eq=False)
class Portrait:
    """What a client without the avatar's file knows of an avatar."""

    coefficients: Coefficients
    camera: Camera
    preset: str


def drive(
    head: HeadModel,
    avatar: Driven,
    face: TrackedFace,
    *,
    reference: TrackedFace | None = None,
    crop: Crop | None = None,
) -> tuple[Coefficients, Camera]:
    """Expression and pose of the driver on the avatar's identity (paper equation 2).

    In the open preset the head turns at the neck and the shoulders stay as in the portrait, see
    :func:`at_neck`; in the official one the body turns along, as in the released code.

    Args:
        head: the head model of both.
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
        # The difference first: where the driver has not moved it is exactly nothing.
        expression = source.expression + (driver.expression - start.expression)
        pose = np.concatenate(
            [composed(composed(driver.joint(j), -start.joint(j)), source.joint(j)) for j in JOINTS]
        )
        if crop is not None:
            camera = _moved(avatar.camera, reference.camera.in_crop(crop), camera)
    wanted = replace(source, expression=expression, pose=pose)
    if avatar.preset == "official":
        return wanted, camera
    if crop is None:
        return _turned(source, wanted), camera
    return at_neck(head, source, wanted, camera)


def at_neck(
    head: HeadModel, source: Coefficients, wanted: Coefficients, camera: Camera
) -> tuple[Coefficients, Camera]:
    """The wanted head in the same place, on shoulders that stand as the source's do.

    A tracker sees the face alone and gives its whole turn to the global joint. People turn their
    heads at the neck: moved to that joint, the same picture of the face leaves the body still.

    Args:
        head: the head model.
        source: coefficients of the portrait.
        wanted: coefficients of the driven frame.
        camera: of the driven frame; the result's is shifted so that the face does not move.
    """
    turned = _turned(source, wanted)
    rest = head.rest(wanted)
    centre = np.append(rest[head.region == Region.FACE].mean(axis=0), 1)
    joints = head.joints(rest)
    x, y, _ = (
        head.transforms(wanted.pose, joints)[HEAD] - head.transforms(turned.pose, joints)[HEAD]
    ) @ centre
    return turned, Camera(camera.scale, camera.tx + float(x), camera.ty + float(y))


def _turned(source: Coefficients, wanted: Coefficients) -> Coefficients:
    """``wanted`` with the source's global rotation and the rest of the head's turn at the neck."""
    body = _matrix(source.joint("global"))
    skull = _matrix(wanted.joint("global")) @ _matrix(wanted.joint("neck"))
    neck = cv2.Rodrigues(body.T @ skull)[0].ravel()
    return wanted.with_joints({"global": source.joint("global"), "neck": neck})


def _matrix(rotation: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(cv2.Rodrigues(np.asarray(rotation, np.float64))[0], np.float64)


def _moved(source: Camera, start: Camera, now: Camera) -> Camera:
    """The source's camera with the change of scale and place between two driving cameras."""
    return Camera(
        source.scale * now.scale / start.scale,
        source.tx + now.tx - start.tx,
        source.ty + now.ty - start.ty,
    )
