"""The stream's binary messages: one definition for the service and its clients.

A message is a header of 24 bytes, little-endian, and a payload:

    offset  size  field
    0       1     magic, 0xC7
    1       1     version, 1
    2       1     type (:class:`Kind`)
    3       1     codec of the payload (:class:`Codec`)
    4       4     sequence, chosen by the client for each frame that it sends
    8       8     capture time in microseconds, on any clock of the client
    16      4     length of the payload in bytes
    20      4     reserved, 0

docs/streaming.md describes how they are exchanged.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Collection
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvthead_client.errors import WireError

MAGIC = 0xC7
VERSION = 1
HEADER = struct.Struct("<BBBBIQII")
# What a 1024 x 1024 px RGBA picture has uncompressed.
MAX_PAYLOAD = 4 * 2**20
MAX_SEQUENCE = 2**32 - 1
MAX_CAPTURE_TIME = 2**64 - 1

EXPRESSION_SIZE, POSE_SIZE, CAMERA_SIZE, SHAPE_SIZE = 50, 15, 3, 100
_SHORT = EXPRESSION_SIZE + POSE_SIZE + CAMERA_SIZE
_LONG = _SHORT + SHAPE_SIZE
EXPRESSION_LIMIT, POSE_LIMIT, SHAPE_LIMIT, CAMERA_LIMIT = 50.0, 2 * np.pi, 20.0, 1e6


class Kind(IntEnum):
    """Type of a message."""

    COEFFICIENTS = 1
    DRIVING = 2
    RENDERED = 3
    ACK = 4
    STATS = 5
    REFERENCE = 6


class Codec(IntEnum):
    """What a payload is."""

    NONE = 0
    JPEG = 1
    PNG = 2
    WEBP = 3


FROM_CLIENT = frozenset({Kind.COEFFICIENTS, Kind.DRIVING, Kind.ACK, Kind.REFERENCE})
FROM_SERVICE = frozenset({Kind.RENDERED, Kind.STATS})
PICTURES = frozenset({Kind.DRIVING, Kind.REFERENCE, Kind.RENDERED})


@dataclass(frozen=True)
class Message:
    """One binary message of the stream.

    Attributes:
        sequence: 0 .. 2**32 - 1; of RENDERED and ACK, that of the frame they answer.
        capture_time: microseconds, 0 .. 2**64 - 1; echoed in RENDERED.

    Raises:
        WireError: on construction, for a field out of range or a payload that is not of the
            type and codec.
    """

    kind: Kind
    codec: Codec
    sequence: int
    capture_time: int
    payload: bytes

    def __post_init__(self) -> None:
        if not 0 <= self.sequence <= MAX_SEQUENCE or not 0 <= self.capture_time <= MAX_CAPTURE_TIME:
            raise WireError("sequence or capture time does not fit its field")
        if len(self.payload) > MAX_PAYLOAD:
            raise WireError(
                f"a payload of {len(self.payload):,} bytes, at most {MAX_PAYLOAD:,} are possible",
                hint="send smaller or more compressed pictures",
                code="body_too_large",
            )
        if self.kind in PICTURES:
            if sniff(self.payload) is not self.codec:
                raise WireError(
                    f"the payload of {self.kind.name} is not a picture in its codec, "
                    f"{self.codec.name}"
                )
        elif self.codec is not Codec.NONE:
            raise WireError(f"{self.kind.name} has codec {self.codec.name}, expected NONE")
        elif self.kind is Kind.ACK and self.payload:
            raise WireError("ACK has a payload")
        elif self.kind is Kind.COEFFICIENTS and len(self.payload) not in (4 * _SHORT, 4 * _LONG):
            raise WireError(
                f"COEFFICIENTS has {len(self.payload)} bytes, expected {4 * _SHORT} or {4 * _LONG}"
            )


def sniff(data: bytes) -> Codec:
    """The codec of a picture by its first bytes; NONE for anything else."""
    if data.startswith(b"\xff\xd8\xff"):
        return Codec.JPEG
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return Codec.PNG
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return Codec.WEBP
    return Codec.NONE


def pack(message: Message) -> bytes:
    """The bytes of a message."""
    m = message
    header = HEADER.pack(
        MAGIC, VERSION, m.kind, m.codec, m.sequence, m.capture_time, len(m.payload), 0
    )
    return header + m.payload


def unpack(data: bytes, allowed: Collection[Kind]) -> Message:
    """Parse and check one message.

    Args:
        data: the whole message; may be any bytes.
        allowed: types that the other side may send, FROM_CLIENT or FROM_SERVICE.

    Raises:
        WireError: anything but a complete message of version 1 with an allowed type.
    """
    if len(data) < HEADER.size:
        raise WireError(f"a message of {len(data)} bytes, the header alone has {HEADER.size}")
    magic, version, kind, codec, sequence, capture_time, length, reserved = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise WireError(f"the first byte is {magic:#04x}, expected {MAGIC:#04x}")
    if version != VERSION:
        raise WireError(f"header version {version}, expected {VERSION}", code="unsupported_version")
    if kind not in allowed:
        raise WireError(f"type {kind} is unknown or not for this direction")
    if codec not in list(Codec):
        raise WireError(f"codec {codec} is unknown")
    if reserved:
        raise WireError("the reserved field is not 0")
    if length != len(data) - HEADER.size:
        raise WireError(f"length says {length} bytes, {len(data) - HEADER.size} follow")
    payload = bytes(data[HEADER.size :])
    return Message(Kind(kind), Codec(codec), sequence, capture_time, payload)


@dataclass(frozen=True, eq=False)
class CoefficientFrame:
    """The payload of COEFFICIENTS, FLAME semantics. Kept as float32, whatever is given.

    Attributes:
        expression: (50,) standard deviations, within +-50.
        pose: (15,) axis-angle in radians of global, neck, jaw, left eye, right eye, +-2 pi.
        camera: (3,) scale (above 0), tx, ty of the normalised weak-perspective camera; None
            keeps the portrait's.
        shape: (100,) standard deviations, within +-20; None keeps the portrait's.

    Raises:
        WireError: on construction, for a wrong length, NaN or a value out of range.
    """

    expression: NDArray[np.floating]
    pose: NDArray[np.floating]
    camera: NDArray[np.floating] | None = None
    shape: NDArray[np.floating] | None = None

    def __post_init__(self) -> None:
        for name, size, limit in (
            ("expression", EXPRESSION_SIZE, EXPRESSION_LIMIT),
            ("pose", POSE_SIZE, POSE_LIMIT),
            ("camera", CAMERA_SIZE, CAMERA_LIMIT),
            ("shape", SHAPE_SIZE, SHAPE_LIMIT),
        ):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, _checked(name, value, size, limit))
            elif name in ("expression", "pose"):
                raise _invalid(f"{name} is missing")
        if self.camera is not None and self.camera[0] <= 0:
            raise _invalid(f"camera has scale {self.camera[0]:g}, expected one above 0")


def _checked(name: str, value: ArrayLike, size: int, limit: float) -> NDArray[np.float32]:
    try:
        with np.errstate(over="ignore"):  # becomes infinite, which is refused below
            array = np.array(value, dtype=np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise _invalid(f"{name} is not a list of numbers") from error
    if array.shape != (size,):
        raise _invalid(f"{name} has shape {list(array.shape)}, expected [{size}]")
    if not np.isfinite(array).all():
        raise _invalid(f"{name} holds NaN or infinity")
    if np.abs(array).max() > limit:
        raise _invalid(f"{name} has a value beyond +-{limit:g}")
    array.flags.writeable = False
    return array


def _invalid(message: str) -> WireError:
    return WireError(message, hint="send finite numbers in range", code="invalid_coefficients")


def pack_coefficients(frame: CoefficientFrame) -> bytes:
    """float32: expression 50, pose 15, camera 3 (NaN for None), then shape 100 if given."""
    camera = np.full(CAMERA_SIZE, np.nan, np.float32) if frame.camera is None else frame.camera
    parts = [frame.expression, frame.pose, camera]
    if frame.shape is not None:
        parts.append(frame.shape)
    return np.concatenate(parts).astype("<f4").tobytes()


def unpack_coefficients(payload: bytes) -> CoefficientFrame:
    """Parse and check the payload of COEFFICIENTS.

    Raises:
        WireError: wrong length, NaN outside of the camera, a value out of range.
    """
    if len(payload) not in (4 * _SHORT, 4 * _LONG):
        raise _invalid(f"{len(payload)} bytes, expected {4 * _SHORT} or {4 * _LONG}")
    values = np.frombuffer(payload, "<f4")
    expression, pose, camera, shape = np.split(
        values, [EXPRESSION_SIZE, EXPRESSION_SIZE + POSE_SIZE, _SHORT]
    )
    return CoefficientFrame(
        expression,
        pose,
        None if np.isnan(camera).all() else camera,
        shape if len(shape) else None,
    )


@dataclass(frozen=True)
class Stats:
    """Frames since the stream began.

    Attributes:
        received: frames that the client sent.
        rendered: frames that were sent back.
        dropped: frames that a newer one replaced before they were begun, or that an overloaded
            service refused.
        lost_face: driving frames in which no face was found.
    """

    received: int = 0
    rendered: int = 0
    dropped: int = 0
    lost_face: int = 0


def pack_stats(stats: Stats) -> bytes:
    return json.dumps(asdict(stats)).encode()


def unpack_stats(payload: bytes) -> Stats:
    """Parse the payload of STATS; names that this version does not know are ignored.

    Raises:
        WireError: not a JSON object with the four counts.
    """
    document = parse_json(payload)
    counts: dict[str, Any] = {name: document.get(name) for name in Stats.__dataclass_fields__}
    if not all(type(count) is int and count >= 0 for count in counts.values()):
        raise WireError("STATS lacks a count")
    return Stats(**counts)


def parse_json(text: str | bytes) -> dict[str, Any]:
    """A small JSON object from the other side.

    Raises:
        WireError: too long, not JSON, not an object.
    """
    if len(text) > 16_384:
        raise WireError(f"a JSON message of {len(text)} bytes")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        raise WireError("a message is not JSON") from error
    if not isinstance(document, dict):
        raise WireError("a message is not a JSON object")
    return document
