"""A client of the stream that does what a test says and nothing else, such as acknowledging."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from cvthead_client import wire
from cvthead_client.hello import Hello
from cvthead_client.wire import Codec, CoefficientFrame, Kind, Message, Stats
from PIL import Image
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

SECONDS = 60  # for one reply of a busy machine


@dataclass(eq=False)
class RawStream:
    socket: ClientConnection

    def hello(self, hello: Hello | None = None) -> dict[str, Any]:
        self.socket.send((hello or Hello()).to_json())
        answer: dict[str, Any] = json.loads(self.socket.recv(SECONDS))
        return answer

    def send(self, message: Message) -> None:
        self.socket.send(wire.pack(message))

    def numbers(self, sequence: int, frame: CoefficientFrame | None = None, time: int = 0) -> None:
        payload = wire.pack_coefficients(frame or coefficients())
        self.send(Message(Kind.COEFFICIENTS, Codec.NONE, sequence, time, payload))

    def picture(self, sequence: int, data: bytes, kind: Kind = Kind.DRIVING, time: int = 0) -> None:
        self.send(Message(kind, wire.sniff(data), sequence, time, data))

    def acknowledge(self, sequence: int) -> None:
        self.send(Message(Kind.ACK, Codec.NONE, sequence, 0, b""))

    def receive(self, timeout: float = SECONDS) -> Message:
        data = self.socket.recv(timeout)
        assert isinstance(data, bytes), data
        return wire.unpack(data, wire.FROM_SERVICE)

    def rendered(self, timeout: float = SECONDS) -> Message:
        """The next rendered frame; counts before it are skipped."""
        while (message := self.receive(timeout)).kind is not Kind.RENDERED:
            pass
        return message

    def stats(self) -> tuple[int, Stats]:
        """The next counts, and the sequence that they include."""
        message = self.receive()
        assert message.kind is Kind.STATS
        return message.sequence, wire.unpack_stats(message.payload)

    def ending(self) -> tuple[int, str]:
        """Close code and the problem's code before it; "" without one."""
        problem = ""
        while (data := self._next_or_none()) is not None:
            if isinstance(data, str) and json.loads(data)["type"] == "error":
                problem = json.loads(data)["code"]
                assert json.loads(data)["detail"]
        assert self.socket.close_code is not None
        return self.socket.close_code, problem

    def _next_or_none(self) -> str | bytes | None:
        try:
            return self.socket.recv(SECONDS)
        except ConnectionClosed:
            return None


@contextmanager
def raw_stream(
    host: str, avatar: str, query: str = "", headers: dict[str, str] | None = None
) -> Iterator[RawStream]:
    url = f"ws://{host}/v1/avatars/{avatar}/stream{query}"
    with connect(url, additional_headers=headers, compression=None, max_size=None) as socket:
        yield RawStream(socket)


def coefficients(jaw: float = 0.0) -> CoefficientFrame:
    pose = np.zeros(15, np.float32)
    pose[6] = jaw
    return CoefficientFrame(np.zeros(50, np.float32), pose)


def jpeg(image: np.ndarray | Image.Image) -> bytes:
    out = BytesIO()
    picture = image if isinstance(image, Image.Image) else Image.fromarray(image)
    picture.convert("RGB").save(out, "JPEG", quality=95)
    return out.getvalue()


def noise(side: int = 256) -> bytes:
    """A picture without a face, that no codec makes small."""
    return jpeg(np.random.default_rng(0).integers(0, 256, (side, side, 3), np.uint8))


def pixels(data: bytes) -> np.ndarray:
    with Image.open(BytesIO(data)) as image:
        return np.asarray(image).astype(np.int16)
