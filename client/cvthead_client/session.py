"""A stream's client side without the socket: what to send, and what an incoming message means."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import quote

from websockets.exceptions import (
    ConnectionClosed,
    InvalidHandshake,
    InvalidStatus,
    WebSocketException,
)

from cvthead_client import wire
from cvthead_client.errors import (
    ConnectError,
    CVTHeadClientError,
    RequestTimeoutError,
    StreamClosedError,
    UnexpectedReplyError,
    WireError,
    service_error,
)
from cvthead_client.hello import Welcome
from cvthead_client.replies import retry_after
from cvthead_client.wire import Codec, CoefficientFrame, Kind, Message, Stats, parse_json

MAX_MESSAGE = wire.HEADER.size + wire.MAX_PAYLOAD
NORMAL_CLOSURE = 1000
# What a close code means when no error message came before it.
CLOSE_CODES: Mapping[int, str] = {
    1001: "draining",
    1008: "forbidden",
    1009: "body_too_large",
    1011: "internal",
    1013: "overloaded",
    4404: "avatar_not_found",
    4409: "model_changed",
    4410: "avatar_expired",
}


@dataclass(frozen=True)
class Rendered:
    """A frame that the service rendered.

    Attributes:
        sequence: of the driving frame that it answers.
        capture_time: of that frame, microseconds, as it was sent.
        data: the picture's file, in the codec of the stream's output.
    """

    sequence: int
    capture_time: int
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class Report:
    """The service's counts. ``sequence``: the newest driving frame that they include."""

    sequence: int
    stats: Stats


@dataclass(eq=False)
class Session:
    """State of one open stream: the next sequence number and the latest counts."""

    welcome: Welcome
    stats: Stats = field(default_factory=Stats)
    _next: int = 0

    def coefficients(self, frame: CoefficientFrame, capture_time: int | None) -> tuple[int, bytes]:
        """Sequence and bytes of a message."""
        payload = wire.pack_coefficients(frame)
        return self._frame(Kind.COEFFICIENTS, Codec.NONE, payload, capture_time)

    def picture(
        self, data: bytes, capture_time: int | None, *, reference: bool
    ) -> tuple[int, bytes]:
        """Sequence and bytes of a message."""
        kind = Kind.REFERENCE if reference else Kind.DRIVING
        codec = wire.sniff(data)
        if codec is Codec.NONE:
            raise WireError("a driving frame is no JPEG, PNG or WebP file")
        return self._frame(kind, codec, data, capture_time)

    def _frame(
        self, kind: Kind, codec: Codec, payload: bytes, capture_time: int | None
    ) -> tuple[int, bytes]:
        stamp = time.monotonic_ns() // 1000 if capture_time is None else capture_time
        sequence = self._next
        data = wire.pack(Message(kind, codec, sequence, stamp, payload))
        self._next = (sequence + 1) & wire.MAX_SEQUENCE
        return sequence, data

    def read(self, data: str | bytes) -> Rendered | Report:
        """Parse a message of the service.

        Raises:
            ServiceError: it is an error message.
            WireError: it breaks the protocol.
        """
        if isinstance(data, str):
            document = parse_json(data)
            if document.get("type") == "error":
                raise service_error(document)
            raise WireError("an unexpected text message")
        message = wire.unpack(data, wire.FROM_SERVICE)
        if message.kind is Kind.STATS:
            self.stats = wire.unpack_stats(message.payload)
            return Report(message.sequence, self.stats)
        return Rendered(message.sequence, message.capture_time, message.payload)


def stream_url(server: str, avatar_id: str) -> str:
    """The WebSocket's address; ``server`` is http or https."""
    return f"ws{server.removeprefix('http')}/v1/avatars/{quote(avatar_id, safe='')}/stream"


def acknowledgement(frame: Rendered) -> bytes:
    return wire.pack(Message(Kind.ACK, Codec.NONE, frame.sequence, frame.capture_time, b""))


def welcome_of(data: str | bytes) -> Welcome:
    """Parse the service's first message.

    Raises:
        ServiceError: it refuses the stream.
        WireError: it breaks the protocol.
    """
    if not isinstance(data, str):
        raise WireError("the service's first message is not text")
    document = parse_json(data)
    if document.get("type") == "error":
        raise service_error(document)
    return Welcome.of(document)


def closed_error(closed: ConnectionClosed) -> CVTHeadClientError | None:
    """Why a stream ended; None if it was closed normally."""
    frame = closed.rcvd or closed.sent
    code = frame.code if frame else 1006
    if code == NORMAL_CLOSURE:
        return None
    reason = frame.reason if frame else ""
    if code in CLOSE_CODES and closed.rcvd:
        return service_error({"code": CLOSE_CODES[code], "detail": reason or f"closed with {code}"})
    return StreamClosedError(
        f"the stream ended with close code {code}" + (f": {reason}" if reason else ""),
        hint="open a new stream",
        close_code=code,
    )


def handshake_error(error: Exception, server: str) -> CVTHeadClientError:
    """This package's exception for a handshake that failed."""
    if isinstance(error, InvalidStatus):
        response = error.response
        try:
            problem = parse_json(bytes(response.body or b""))
        except WireError:
            problem = {"detail": f"{server} answered {response.status_code}"}
        return service_error(
            problem,
            status=response.status_code,
            retry_after=retry_after(response.headers.get("Retry-After")),
        )
    if isinstance(error, TimeoutError):
        return RequestTimeoutError(f"{server} did not answer in time", hint="try again")
    if isinstance(error, OSError):
        return ConnectError(
            f"cannot reach {server}: {error.strerror or error}",
            hint="is the service running at this address?",
        )
    assert isinstance(error, (InvalidHandshake, WebSocketException))
    return UnexpectedReplyError(
        f"{server} did not open a stream: {error}",
        hint="is this the address of a cvthead service?",
    )
