"""The stream's messages: what is accepted is exact, anything else is a WireError."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cvthead_client import hello, wire
from cvthead_client.errors import WireError
from cvthead_client.hello import Hello, StreamOutput, Welcome
from cvthead_client.wire import Codec, CoefficientFrame, Kind, Message

JPEG = b"\xff\xd8\xff and the rest"
ACK = Message(Kind.ACK, Codec.NONE, 7, 0, b"")
EVERY_KIND = frozenset(Kind)


def frame() -> CoefficientFrame:
    rng = np.random.default_rng(0)
    return CoefficientFrame(
        rng.normal(size=50), rng.normal(size=15), np.array([5.0, 0.1, -0.2]), rng.normal(size=100)
    )


def test_header_layout_is_fixed() -> None:
    """Byte for byte what docs/streaming.md says: other languages write it too."""
    data = wire.pack(Message(Kind.DRIVING, Codec.JPEG, 0x01020304, 0x1112131415161718, JPEG))
    assert data == bytes.fromhex("c7010201 04030201 1817161514131211 10000000 00000000") + JPEG


@pytest.mark.parametrize(
    "message",
    [
        ACK,
        Message(Kind.DRIVING, Codec.JPEG, 2**32 - 1, 2**64 - 1, JPEG),
        Message(Kind.RENDERED, Codec.PNG, 0, 0, b"\x89PNG\r\n\x1a\n.."),
        Message(Kind.REFERENCE, Codec.WEBP, 1, 2, b"RIFF\0\0\0\0WEBPVP8 "),
        Message(Kind.STATS, Codec.NONE, 1, 2, b"{}"),
    ],
    ids=lambda message: message.kind.name,
)
def test_round_trip(message: Message) -> None:
    assert wire.unpack(wire.pack(message), EVERY_KIND) == message


@pytest.mark.parametrize("parts", [{}, {"camera": None}, {"shape": None}])
def test_coefficients_round_trip(parts: dict[str, Any]) -> None:
    sent = replace(frame(), **parts)
    back = wire.unpack_coefficients(wire.pack_coefficients(sent))
    for name in ("expression", "pose", "camera", "shape"):
        np.testing.assert_equal(getattr(back, name), getattr(sent, name))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (0, 0xC8),  # magic
        (2, 0),  # type
        (2, 99),
        (2, Kind.RENDERED),  # wrong direction
        (3, 9),  # codec
        (3, Codec.PNG),  # not what the payload is
        (3, Codec.NONE),
        (16, 3),  # length
        (20, 1),  # reserved
    ],
)
def test_one_wrong_byte_is_refused(place: int, value: int) -> None:
    data = bytearray(wire.pack(Message(Kind.DRIVING, Codec.JPEG, 1, 2, JPEG)))
    wire.unpack(bytes(data), wire.FROM_CLIENT)
    data[place] = value
    with pytest.raises(WireError) as raised:
        wire.unpack(bytes(data), wire.FROM_CLIENT)
    assert raised.value.code == "protocol_error"


def test_other_version_has_its_own_code() -> None:
    data = bytearray(wire.pack(ACK))
    data[1] = 2
    with pytest.raises(WireError) as raised:
        wire.unpack(bytes(data), wire.FROM_CLIENT)
    assert raised.value.code == "unsupported_version"


def test_random_bytes_raise_nothing_but_wire_errors() -> None:
    rng = random.Random(0)
    valid = [
        wire.pack(Message(Kind.COEFFICIENTS, Codec.NONE, 1, 2, wire.pack_coefficients(frame()))),
        wire.pack(Message(Kind.DRIVING, Codec.JPEG, 1, 2, JPEG)),
        wire.pack(ACK),
    ]
    accepted = 0
    for number in range(20_000):
        if number % 2:
            data = bytearray(rng.choice(valid))
            for _ in range(rng.randrange(1, 4)):
                data[rng.randrange(len(data))] = rng.randrange(256)
            if rng.random() < 0.2:
                del data[rng.randrange(len(data)) :]
        else:
            data = bytearray(rng.randbytes(rng.randrange(64)))
            if data:
                data[0] = wire.MAGIC
        try:
            message = wire.unpack(bytes(data), wire.FROM_CLIENT)
            if message.kind is Kind.COEFFICIENTS:
                wire.unpack_coefficients(message.payload)
        except WireError:
            continue
        accepted += 1
        assert wire.pack(message) == bytes(data)
    assert accepted > 1000  # else the loop above only tests that nonsense is refused


def test_random_hellos_raise_nothing_but_wire_errors() -> None:
    rng = random.Random(1)
    text = Hello().to_json()
    alphabet = '{}[]",:0123456789truefalsnN-.e\\u \x00\ud800'
    for number in range(5_000):
        broken = list(text)
        for _ in range(rng.randrange(1, 6)):
            broken[rng.randrange(len(broken))] = rng.choice(alphabet)
        try:
            Hello.from_json("".join(broken) if number % 2 else "".join(broken[: number % 99]))
        except WireError:
            continue
    for nasty in ("[" * 16_000, "9" * 16_000, '{"type":"hello","versions":[1],"window":1e999}'):
        with pytest.raises(WireError):
            Hello.from_json(nasty)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("expression", np.zeros(49)),
        ("expression", np.full(50, np.nan)),
        ("expression", np.full(50, 51.0)),
        ("expression", "text"),
        ("expression", None),
        ("pose", np.full(15, 7.0)),
        ("pose", [[0.0] * 15]),
        ("camera", [0.0, 0.0, 0.0]),
        ("camera", [1.0, np.inf, 0.0]),
        ("camera", [1.0, np.nan, 0.0]),
        ("shape", np.full(100, -21.0)),
    ],
)
def test_wrong_coefficients_are_refused(name: str, value: Any) -> None:
    with pytest.raises(WireError) as raised:
        replace(frame(), **{name: value})
    assert raised.value.code == "invalid_coefficients"


def test_half_a_camera_is_refused() -> None:
    payload = bytearray(wire.pack_coefficients(replace(frame(), camera=None, shape=None)))
    payload[-4:] = np.float32(0.5).tobytes()
    with pytest.raises(WireError):
        wire.unpack_coefficients(bytes(payload))


def test_oversized_payload_is_refused() -> None:
    with pytest.raises(WireError) as raised:
        Message(Kind.DRIVING, Codec.JPEG, 1, 2, JPEG + bytes(wire.MAX_PAYLOAD))
    assert raised.value.code == "body_too_large"


def test_sequence_must_fit() -> None:
    with pytest.raises(WireError):
        replace(ACK, sequence=2**32)


def test_hello_round_trip() -> None:
    sent = Hello(
        StreamOutput("webp", 128, "transparent", 50), "relative", "driver", window=3, smooth=False
    )
    assert Hello.from_json(sent.to_json()) == sent
    assert Hello.from_json('{"type":"hello","versions":[2,1]}') == Hello()


@pytest.mark.parametrize(
    "wrong",
    [
        {"type": "hallo"},
        {"versions": []},
        {"versions": [2]},
        {"versions": "1"},
        {"window": 0},
        {"window": hello.MAX_WINDOW + 1},
        {"window": True},
        {"window": 1.5},
        {"mode": "sideways"},
        {"mode": ["absolute"]},
        {"camera": {}},
        {"smooth": 1},
        {"unknown": 1},
        {"output": []},
        {"output": {"codec": "gif"}},
        {"output": {"codec": ["jpeg"]}},
        {"output": {"codec": "jpeg", "background": "transparent"}},
        {"output": {"background": "#12345"}},
        {"output": {"background": 3}},
        {"output": {"size": 15}},
        {"output": {"size": 1025}},
        {"output": {"quality": 0}},
        {"output": {"unknown": 1}},
    ],
    ids=json.dumps,
)
def test_wrong_hello_is_refused(wrong: dict[str, object]) -> None:
    document = json.loads(Hello().to_json())
    with pytest.raises(WireError):
        Hello.from_json(json.dumps(document | wrong))


def test_welcome_round_trip_ignores_new_fields() -> None:
    sent = Welcome(1, "a" * 32, "http://example.org/type", 2, StreamOutput())
    assert Welcome.of(json.loads(sent.to_json()) | {"later": 1}) == sent


def test_stats_round_trip() -> None:
    stats = wire.Stats(4, 3, 2, 1)
    assert wire.unpack_stats(wire.pack_stats(stats)) == stats
    assert wire.unpack_stats(wire.pack_stats(stats)[:-1] + b', "later": 1}') == stats
    for wrong in (b"", b"\xff", b"[]", b'{"received": -1}', b'{"received": true}'):
        with pytest.raises(WireError):
            wire.unpack_stats(wrong)
