"""The stream's text messages: the hello of each side, and the service's error."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

from cvthead_client.errors import WireError
from cvthead_client.wire import VERSION, Codec, parse_json

ImageCodec = Literal["jpeg", "png", "webp"]
Mode = Literal["absolute", "relative"]
CameraChoice = Literal["source", "driver"]

MIN_SIZE, MAX_SIZE = 16, 1024
MAX_WINDOW = 8
_BACKGROUND = re.compile(r"#[0-9a-fA-F]{6}|white|transparent|source")
CODECS: Mapping[ImageCodec, Codec] = {"jpeg": Codec.JPEG, "png": Codec.PNG, "webp": Codec.WEBP}


@dataclass(frozen=True)
class StreamOutput:
    """How the rendered frames come back.

    Attributes:
        size: side in pixels, 16 to 1024; 256 is native.
        background: "#rrggbb", "white", "transparent" (not JPEG) or "source", the portrait's own.
        quality: 1 to 100 of JPEG and WebP.
    """

    codec: ImageCodec = "jpeg"
    size: int = 256
    background: str = "white"
    quality: int = 80

    def __post_init__(self) -> None:
        _choice("output.codec", self.codec, get_args(ImageCodec))
        _integer("output.size", self.size, MIN_SIZE, MAX_SIZE)
        _integer("output.quality", self.quality, 1, 100)
        if not isinstance(self.background, str) or not _BACKGROUND.fullmatch(self.background):
            raise _wrong("output.background", "#rrggbb, white, transparent or source")
        if self.background == "transparent" and self.codec == "jpeg":
            raise WireError("JPEG cannot be transparent", hint="use png or webp, or a colour")


@dataclass(frozen=True)
class Hello:
    """The client's first message.

    Attributes:
        versions: header versions that the client speaks.
        mode: "absolute" copies the driver's expression and pose. "relative" adds to the
            portrait's own: the motion since the reference frame, or the coefficients as sent.
        camera: of driving frames: "source" keeps the portrait's, "driver" follows the driver's
            head in place and size.
        window: rendered frames that may be unacknowledged, 1 to 8.
        smooth: filter the tracked motion of driving frames.

    Raises:
        WireError: on construction, for a value out of range.
    """

    output: StreamOutput = field(default_factory=StreamOutput)
    mode: Mode = "absolute"
    camera: CameraChoice = "source"
    window: int = 2
    smooth: bool = True
    versions: tuple[int, ...] = (VERSION,)

    def __post_init__(self) -> None:
        _choice("mode", self.mode, get_args(Mode))
        _choice("camera", self.camera, get_args(CameraChoice))
        _integer("window", self.window, 1, MAX_WINDOW)
        if type(self.smooth) is not bool:
            raise _wrong("smooth", "true or false")

    def to_json(self) -> str:
        return json.dumps({"type": "hello", **asdict(self), "versions": list(self.versions)})

    @classmethod
    def from_json(cls, text: str) -> Hello:
        """Parse and check; what is left out has its default.

        Raises:
            WireError: not a hello, no version in common (code ``unsupported_version``), an
                unknown field or a value out of range.
        """
        document = parse_json(text)
        if document.pop("type", None) != "hello":
            raise WireError("the first message is not a hello")
        versions = document.pop("versions", None)
        # Before everything else: fields may differ in other versions.
        if not isinstance(versions, list) or VERSION not in versions:
            raise WireError(
                f"no version in common: the client has {str(versions)[:80]}, "
                f"the service has [{VERSION}]",
                hint="update the client or the service",
                code="unsupported_version",
            )
        output = document.pop("output", {})
        if not isinstance(output, dict):
            raise _wrong("output", "an object")
        _known("output.", output, StreamOutput)
        _known("", document, cls)
        return cls(**document, output=StreamOutput(**output), versions=(VERSION,))


@dataclass(frozen=True)
class Welcome:
    """The service's answer to a hello.

    Attributes:
        version: of the headers from now on.
        avatar: id.
        digital_source_type: IPTC DigitalSourceType of every frame of this stream, a URI.
        window: as granted.
        output: as granted.
    """

    version: int
    avatar: str
    digital_source_type: str
    window: int
    output: StreamOutput

    def to_json(self) -> str:
        return json.dumps({"type": "hello", **asdict(self)})

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Welcome:
        """From a parsed message; fields that this version does not know are ignored.

        Raises:
            WireError: not a hello of version 1.
        """
        output = document.get("output")
        if document.get("type") != "hello" or document.get("version") != VERSION:
            raise WireError("the service's first message is not a hello of version 1")
        if not isinstance(output, dict):
            raise _wrong("output", "an object")
        _integer("window", document.get("window"), 1, MAX_WINDOW)
        names = StreamOutput.__dataclass_fields__.keys() & output.keys()
        return cls(
            VERSION,
            str(document.get("avatar", "")),
            str(document.get("digital_source_type", "")),
            document["window"],
            StreamOutput(**{name: output[name] for name in names}),
        )


def error_json(code: str, detail: str, hint: str) -> str:
    """The service's last text message before it closes a stream."""
    return json.dumps({"type": "error", "code": code, "detail": detail, "hint": hint})


def _known(prefix: str, document: dict[str, Any], kind: type) -> None:
    for name in document.keys() - kind.__dataclass_fields__.keys():  # type: ignore[attr-defined]
        raise WireError(f"the hello has an unknown field {prefix}{name[:40]}")


def _choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    if not isinstance(value, str) or value not in choices:
        raise _wrong(name, " or ".join(choices))


def _integer(name: str, value: object, low: int, high: int) -> None:
    # bool is an int, but not here.
    if type(value) is not int or not low <= value <= high:
        raise _wrong(name, f"{low} to {high}")


def _wrong(name: str, expected: str) -> WireError:
    return WireError(f"the hello's {name} is out of range", hint=f"use {expected}")
