"""What ``cvthead-call`` sends for a captured frame: the picture, or numbers tracked here."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from cvthead_client.errors import CVTHeadClientError
from cvthead_client.media import Captured, jpeg_of
from cvthead_client.stream import Stream
from cvthead_client.types import AvatarInfo
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
    stream: Stream, avatar: AvatarInfo, mode: Literal["absolute", "relative"], *, follow: bool
) -> Send:
    """Finds the face here and sends its coefficients; no picture leaves this machine.

    Args:
        stream: in the mode "absolute": relative motion is worked out here.
        avatar: that is driven, with its source coefficients (not from a list).
        mode: "relative" adds the motion since the first frame to the portrait.
        follow: whether place and size of the driver's head are followed too.
    """
    track = LocalTracker(avatar, mode, follow=follow)

    def send(frame: Captured) -> int | None:
        coefficients = track.step(frame)
        if coefficients is None:
            return None
        return stream.send_coefficients(coefficients, capture_time=round(frame.time * 1e6))

    return send


class LocalTracker:
    """Follows one face and gives what the stream's COEFFICIENTS hold, computed as the service
    does it for pictures."""

    def __init__(
        self, avatar: AvatarInfo, mode: Literal["absolute", "relative"], *, follow: bool
    ) -> None:
        from cvthead.camera import Camera
        from cvthead.coefficients import Coefficients
        from cvthead.driving import Portrait
        from cvthead.tracking.one_euro import FaceFilter
        from cvthead.tracking.tracker import Tracker

        portrait = avatar.source
        if portrait is None:
            raise CVTHeadClientError(
                "the avatar's coefficients are not known", hint="use Client.get(id)"
            )
        if avatar.preset != "open":
            raise CVTHeadClientError(
                f"the avatar is of the preset {avatar.preset}; its coefficients mean another head "
                "than the one that is tracked here",
                hint="use --frames",
            )
        pose, camera = portrait.pose, portrait.camera
        joints = (pose.global_rotation, pose.neck, pose.jaw, pose.left_eye, pose.right_eye)
        self._portrait = Portrait(
            Coefficients(
                np.asarray(portrait.shape, np.float32),
                np.asarray(portrait.expression, np.float32),
                np.concatenate([np.asarray(joint, np.float32) for joint in joints]),
            ),
            Camera(camera.scale, camera.tx, camera.ty),
            avatar.preset,
        )
        self._mode = mode
        self._follow = follow
        self._tracker = Tracker.load()
        self._filter = FaceFilter()
        self._previous: TrackedFace | None = None
        self._start: TrackedFace | None = None

    def step(self, frame: Captured) -> CoefficientFrame | None:
        """The smoothed coefficients; None when no face is found."""
        from cvthead.crop import head_crop
        from cvthead.driving import drive
        from cvthead.errors import FaceError
        from cvthead.tracking.tracker import FaceTurnedWarning

        head = self._tracker.head
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
        start = self._start = self._start or face
        crop = head_crop(head, start.coefficients, start.camera) if self._follow else None
        reference = start if self._mode == "relative" else None
        driven, seen = drive(head, self._portrait, face, reference=reference, crop=crop)
        place = np.array([seen.scale, seen.tx, seen.ty], np.float32) if self._follow else None
        return CoefficientFrame(driven.expression, driven.pose, place)
