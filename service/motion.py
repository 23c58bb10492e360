"""From a stream's frames to what the avatar is asked to do."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace

from cvthead_client.hello import Hello
from cvthead_client.wire import CoefficientFrame, Kind, Message, unpack_coefficients

from cvthead.camera import Camera, Crop
from cvthead.coefficients import JOINTS
from cvthead.controls import Controls
from cvthead.crop import head_crop
from cvthead.driving import drive
from cvthead.preset import AnyAvatar
from cvthead.tracking.one_euro import FaceFilter
from cvthead.tracking.tracker import TrackedFace
from service.engine import Engine, Pose

# The face networks look at 256 pixels; more only takes time.
LONGEST_SIDE = 960
# Assumed between two frames whose capture times do not increase.
FRAME_SECONDS = 1 / 30


class Motion:
    """Follows one driver through a stream."""

    def __init__(self, engine: Engine, avatar: AnyAvatar, hello: Hello) -> None:
        self._engine = engine
        self._avatar = avatar
        self._hello = hello
        self._filter = FaceFilter()
        self._time = -math.inf
        self._previous: TrackedFace | None = None
        self._reference: TrackedFace | None = None
        self._crop: Crop | None = None

    async def of(self, message: Message) -> Pose | Controls:
        """What a COEFFICIENTS, DRIVING or REFERENCE message asks for.

        Raises:
            WireError, CoefficientsError: its numbers are out of range.
            ImageError, FaceError: the picture is damaged or shows no usable face.
            Problem: ``overloaded``, ``draining``.
        """
        if message.kind is Kind.COEFFICIENTS:
            return controls_of(unpack_coefficients(message.payload), self._hello)
        face = await self._face(message)
        # A thread: head model and crop take the event loop too long. Numbers, above, do not.
        return await asyncio.to_thread(self._driven, face, message.kind)

    def _driven(self, face: TrackedFace, kind: Kind) -> Pose:
        head = self._engine.pipeline.head
        # Without a reference frame the first one serves.
        if self._reference is None or kind is Kind.REFERENCE:
            self._reference = face
            if self._hello.camera == "driver":
                self._crop = head_crop(head, face.coefficients, face.camera)
        reference = self._reference if self._hello.mode == "relative" else None
        return drive(head, self._avatar, face, reference=reference, crop=self._crop)

    async def _face(self, message: Message) -> TrackedFace:
        image = await self._engine.decode(message.payload, longest=LONGEST_SIDE)
        face = self._previous = await self._engine.track(image, self._previous)
        if not self._hello.smooth:
            return face
        # A client whose clock stands still or jumps back must not stop the filter.
        seconds = message.capture_time / 1e6
        self._time = seconds if seconds > self._time else self._time + FRAME_SECONDS
        coefficients, camera, self._filter = self._filter.step(
            face.coefficients, face.camera, self._time
        )
        return replace(face, coefficients=coefficients, camera=camera)


def controls_of(frame: CoefficientFrame, hello: Hello) -> Controls:
    """The controls that a frame's numbers mean in the mode of the stream."""
    rotations = dict(zip(JOINTS, frame.pose.reshape(len(JOINTS), 3), strict=True))
    camera = None if frame.camera is None else Camera(*frame.camera.tolist())
    return Controls(
        shape=frame.shape,
        expression=frame.expression,
        camera=camera,
        mode=hello.mode,
        global_rotation=rotations["global"],
        neck=rotations["neck"],
        jaw=rotations["jaw"],
        left_eye=rotations["left_eye"],
        right_eye=rotations["right_eye"],
    )
