"""What is sent to the service and what comes back.

Rotations are axis-angle in radians, (x, y, z); head space has +x the subject's left, +y up and
+z out of the face. Shape and expression are in standard deviations of the head model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

Box = tuple[float, float, float, float]
Vector = tuple[float, ...]
PictureFormat = Literal["png", "jpeg", "webp"]
Portrait = Path | str | bytes


@dataclass(frozen=True)
class Camera:
    """Weak perspective: ``x = scale (X + tx)``, ``y = -scale (Y + ty)``; scale above 0."""

    scale: float
    tx: float
    ty: float


@dataclass(frozen=True)
class Pose:
    """Rotations (3,) of the five joints."""

    global_rotation: Vector
    neck: Vector
    jaw: Vector
    left_eye: Vector
    right_eye: Vector

    def flat(self) -> Vector:
        """(15,) in the order of the fields, as the stream carries it."""
        joints = (self.global_rotation, self.neck, self.jaw, self.left_eye, self.right_eye)
        return tuple(value for joint in joints for value in joint)


@dataclass(frozen=True)
class Controls:
    """What to change. None keeps the portrait's value; 0 means zero.

    Attributes:
        shape: (100,), within +-20.
        expression: (50,), within +-50.
        global_rotation, neck, jaw, left_eye, right_eye: (3,) radians.
        arkit: ARKit blendshape name -> 0..1.
        camera: normalised: the frame reaches from -1 to 1.
        mode: "absolute" replaces the portrait's values, "relative" adds to them.
    """

    shape: Sequence[float] | None = None
    expression: Sequence[float] | None = None
    global_rotation: Sequence[float] | None = None
    neck: Sequence[float] | None = None
    jaw: Sequence[float] | None = None
    left_eye: Sequence[float] | None = None
    right_eye: Sequence[float] | None = None
    arkit: Mapping[str, float] | None = None
    camera: Camera | None = None
    mode: Literal["absolute", "relative"] = "absolute"


@dataclass(frozen=True)
class Output:
    """How the picture comes back. None leaves the choice to the service.

    Attributes:
        size: side in pixels, 16 to 1024; 256 is native.
        background: "#rrggbb", "white", "transparent" or "source", the portrait's own.
        quality: 1 to 100 of JPEG and WebP.
    """

    size: int | None = None
    background: str | None = None
    quality: int | None = None


@dataclass(frozen=True)
class Source:
    """The portrait's own coefficients. ``camera`` is normalised: the frame is -1 to 1."""

    shape: Vector
    expression: Vector
    pose: Pose
    camera: Camera


@dataclass(frozen=True)
class AvatarInfo:
    """A stored avatar.

    Attributes:
        id: to be given to the other calls; whoever knows it can render the avatar.
        expires: None for never.
        bytes: size of the stored file.
        preset, fingerprint: the model that made it.
        face_box: in pixels of the portrait.
        source: None in lists.
        links: name -> path on the service.
    """

    id: str
    created: datetime
    expires: datetime | None
    bytes: int
    preset: str
    fingerprint: str
    face_box: Box | None
    source: Source | None
    links: Mapping[str, str]


@dataclass(frozen=True)
class Tracked:
    """A face found in a picture.

    Attributes:
        camera: in pixels of the picture.
        arkit: ARKit blendshape name -> 0..1; empty if not asked for.
        box: of the face, pixels.
        error: mean distance of the fit from the landmarks, percent of the outer-eye distance.
        presence: 0.5..1, belief that this is a face.
    """

    shape: Vector
    expression: Vector
    pose: Pose
    camera: Camera
    arkit: Mapping[str, float]
    box: Box
    error: float
    presence: float

    def controls(self) -> Controls:
        """This face's expression and pose on another identity."""
        pose = self.pose
        return Controls(
            expression=self.expression,
            global_rotation=pose.global_rotation,
            neck=pose.neck,
            jaw=pose.jaw,
            left_eye=pose.left_eye,
            right_eye=pose.right_eye,
        )


@dataclass(frozen=True)
class Picture:
    """An encoded picture.

    Attributes:
        data: the file; it carries the mark for AI-generated media.
        media_type: "image/png" and so on.
        source_type: IPTC DigitalSourceType, a URI.
        timings: stage -> milliseconds, from Server-Timing.
        request_id: identifies the request in the service's logs.
    """

    data: bytes = field(repr=False)
    media_type: str
    source_type: str = ""
    timings: Mapping[str, float] = field(default_factory=dict)
    request_id: str = ""

    def save(self, path: Path | str) -> None:
        """Write the file as it is, so that the mark stays."""
        Path(path).write_bytes(self.data)


def avatar_of(document: Mapping[str, Any]) -> AvatarInfo:
    """From JSON; KeyError, TypeError or ValueError for another document."""
    box, source, expires = document.get("face_box"), document.get("source"), document["expires"]
    return AvatarInfo(
        str(document["id"]),
        _time(document["created"]),
        None if expires is None else _time(expires),
        int(document["bytes"]),
        str(document["preset"]),
        str(document["fingerprint"]),
        None if box is None else _box(box),
        None if source is None else _source(source),
        {str(name): str(path) for name, path in document.get("links", {}).items()},
    )


def tracked_of(document: Mapping[str, Any]) -> Tracked:
    """From JSON; errors as :func:`avatar_of`."""
    source = _source(document)
    arkit = document.get("arkit") or {}
    return Tracked(
        source.shape,
        source.expression,
        source.pose,
        source.camera,
        {str(name): float(weight) for name, weight in arkit.items()},
        _box(document["box"]),
        float(document["error"]),
        float(document["presence"]),
    )


def _source(document: Mapping[str, Any]) -> Source:
    pose, camera = document["pose"], document["camera"]
    joints = ("global", "neck", "jaw", "left_eye", "right_eye")
    return Source(
        _vector(document["shape"]),
        _vector(document["expression"]),
        Pose(*(_vector(pose[joint]) for joint in joints)),
        Camera(float(camera["scale"]), float(camera["tx"]), float(camera["ty"])),
    )


def _vector(values: Sequence[Any]) -> Vector:
    return tuple(float(value) for value in values)


def _box(values: Sequence[Any]) -> Box:
    left, top, right, bottom = _vector(values)
    return left, top, right, bottom


def _time(text: str) -> datetime:
    return datetime.fromisoformat(text)
