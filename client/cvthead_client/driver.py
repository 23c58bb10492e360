"""What ``cvthead-call`` sends for a captured frame: the picture, or numbers tracked here."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from cvthead_client.errors import CVTHeadClientError
from cvthead_client.media import Captured, jpeg_of
from cvthead_client.stream import Stream
from cvthead_client.types import Camera
from cvthead_client.wire import CoefficientFrame

if TYPE_CHECKING:
    from cvthead.tracking.tracker import TrackedFace

# Sends a frame; its sequence, or None when nothing was sent because no face was found here.
Send = Callable[[Captured], int | None]


def can_track() -> bool:
    """Whether the full package, which holds the tracker, is installed here."""
    return importlib.util.find_spec("cvthead") is not None


def not_installed() -> CVTHeadClientError:
    return CVTHeadClientError(
        "--coefficients tracks the face on this machine, which needs the package cvthead",
        hint="use --frames, or install cvthead here (POST /v1/track is for single pictures)",
    )


def picture_sender(stream: Stream) -> Send:
    """Sends the pictures; the service finds the face."""

    def send(frame: Captured) -> int:
        return stream.send_picture(jpeg_of(frame.rgb), capture_time=round(frame.time * 1e6))

    return send


def coefficient_sender(
    stream: Stream, mode: Literal["absolute", "relative"], camera: Camera | None
) -> Send:
    """Finds the face here and sends its coefficients; no picture leaves this machine.

    Args:
        camera: the portrait's, to follow place and size of the driver's head; None keeps it.
    """
    track = LocalTracker(mode, camera)

    def send(frame: Captured) -> int | None:
        coefficients = track.step(frame)
        if coefficients is None:
            return None
        return stream.send_coefficients(coefficients, capture_time=round(frame.time * 1e6))

    return send


class LocalTracker:
    """Follows one face and gives what the stream's COEFFICIENTS hold."""

    def __init__(self, mode: Literal["absolute", "relative"], camera: Camera | None) -> None:
        from cvthead.tracking.one_euro import FaceFilter
        from cvthead.tracking.tracker import Tracker

        self._mode = mode
        self._camera = camera
        self._tracker = Tracker.load()
        self._filter = FaceFilter()
        self._previous: TrackedFace | None = None
        self._start: TrackedFace | None = None

    def step(self, frame: Captured) -> CoefficientFrame | None:
        """The smoothed coefficients; None when no face is found."""
        from cvthead.errors import FaceError
        from cvthead.tracking.tracker import FaceTurnedWarning

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FaceTurnedWarning)
                face = self._previous = self._tracker.track(frame.rgb, previous=self._previous)
        except FaceError:
            return None
        coefficients, camera, self._filter = self._filter.step(
            face.coefficients, face.camera, frame.time
        )
        face = replace(face, coefficients=coefficients, camera=camera)
        self._start = self._start or face
        expression, pose = coefficients.expression, coefficients.pose
        if self._mode == "relative":
            expression = expression - self._start.coefficients.expression
            pose = _turned(face, self._start)
        return CoefficientFrame(expression, pose, self._seen_by(face, self._start))

    def _seen_by(self, face: TrackedFace, start: TrackedFace) -> NDArray[np.float32] | None:
        from cvthead.crop import head_crop

        if self._camera is None:
            return None
        crop = head_crop(self._tracker.head, start.coefficients, start.camera)
        now = face.camera.in_crop(crop)
        if self._mode == "absolute":
            return np.array([now.scale, now.tx, now.ty], np.float32)
        first, own = start.camera.in_crop(crop), self._camera
        moved = own.scale * now.scale / first.scale, own.tx + now.tx - first.tx
        return np.array([*moved, own.ty + now.ty - first.ty], np.float32)


def _turned(face: TrackedFace, start: TrackedFace) -> NDArray[np.float32]:
    """(15,) rotations from the start's pose to the face's."""
    from cvthead.coefficients import JOINTS
    from cvthead.controls import composed

    joints = [composed(face.coefficients.joint(j), -start.coefficients.joint(j)) for j in JOINTS]
    return np.concatenate(joints)
