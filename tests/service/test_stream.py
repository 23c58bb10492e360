"""The stream against a real server: what is exchanged, what is dropped, and why it ends."""

from __future__ import annotations

import dataclasses
import json
import re
import socket
import time
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np
import pytest
from cvthead_client import wire
from cvthead_client.hello import Hello, StreamOutput, Welcome
from cvthead_client.wire import Codec, Kind, Message
from PIL import Image
from raw_stream import SECONDS, RawStream, coefficients, jpeg, noise, pixels, raw_stream
from server_process import PORTRAIT, Server
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from service.streaming import CLOSE_CODES

PNG = StreamOutput("png", background="white")


def upload(client: httpx.Client, **query: object) -> str:
    answer = client.post(
        "/v1/avatars",
        params={name: str(value) for name, value in query.items()},
        content=PORTRAIT.read_bytes(),
        headers={"Content-Type": "image/png"},
    )
    assert answer.status_code == 201, answer.text
    identifier: str = answer.json()["id"]
    return identifier


def frames(client: httpx.Client, event: str) -> float:
    """The service's counter of stream frames."""
    text = client.get("/metrics").text
    found = re.search(rf'cvthead_stream_frames_total{{event="{event}"}} (\S+)', text)
    assert found
    return float(found[1])


def open_streams(client: httpx.Client) -> float:
    found = re.search(r"^cvthead_streams (\S+)", client.get("/metrics").text, re.MULTILINE)
    assert found
    return float(found[1])


def test_coefficients_give_the_same_picture_as_render(
    server: Server, client: httpx.Client, avatar_id: str
) -> None:
    pose = {"global": [0, 0.2, 0], "jaw": [0.2, 0, 0]}
    pose |= {joint: [0, 0, 0] for joint in ("neck", "left_eye", "right_eye")}
    answer = client.post(
        f"/v1/avatars/{avatar_id}/render",
        json={"expression": [0.0] * 50, "pose": pose, "output": {"background": "white"}},
    )
    with raw_stream(server.host, avatar_id) as stream:
        hello = stream.hello(Hello(PNG))
        assert hello["type"] == "hello"
        assert hello["version"] == 1
        assert hello["avatar"] == avatar_id
        assert hello["digital_source_type"].endswith("/trainedAlgorithmicMedia")
        frame = coefficients(jaw=0.2)
        turned = frame.pose.copy()
        turned[1] = 0.2
        stream.numbers(42, wire.CoefficientFrame(frame.expression, turned), time=123_456_789_012)
        reply = stream.rendered()
    assert (reply.sequence, reply.capture_time) == (42, 123_456_789_012)
    assert reply.codec is Codec.PNG
    np.testing.assert_array_equal(pixels(reply.payload), pixels(answer.content))


def test_relative_zero_is_the_portrait(
    server: Server, client: httpx.Client, avatar_id: str
) -> None:
    preview = client.post(
        f"/v1/avatars/{avatar_id}/render", json={"output": {"background": "source"}}
    )
    output = StreamOutput("png", background="source")
    with raw_stream(server.host, avatar_id) as stream:
        hello = stream.hello(Hello(output, mode="relative"))
        assert hello["digital_source_type"].endswith("/compositeWithTrainedAlgorithmicMedia")
        stream.numbers(0)
        reply = stream.rendered()
    np.testing.assert_array_equal(pixels(reply.payload), pixels(preview.content))


def test_driving_frames_move_the_avatar(server: Server, avatar_id: str) -> None:
    """Also with a capture time that stands still, which must not freeze the smoothing."""
    with Image.open(PORTRAIT) as portrait:
        straight = jpeg(portrait)
        tilted = jpeg(portrait.rotate(15, fillcolor="white"))
    with raw_stream(server.host, avatar_id) as stream:
        stream.hello(Hello(PNG))
        stream.picture(0, straight)
        first = pixels(stream.rendered().payload)
        stream.acknowledge(0)
        stream.picture(1, tilted)
        second = pixels(stream.rendered().payload)
    assert np.abs(first - second).mean() > 1


def test_reference_frame_is_the_zero_of_relative_motion(
    server: Server, client: httpx.Client, avatar_id: str
) -> None:
    preview = client.post(
        f"/v1/avatars/{avatar_id}/render", json={"output": {"background": "white"}}
    )
    with Image.open(PORTRAIT) as portrait:
        straight = jpeg(portrait)
        tilted = jpeg(portrait.rotate(15, fillcolor="white"))
    wanted = pixels(preview.content)
    hello = Hello(PNG, mode="relative", camera="driver", smooth=False, window=8)
    with raw_stream(server.host, avatar_id) as stream:
        stream.hello(hello)
        away = {}
        for sequence, (picture, kind) in enumerate(
            [(straight, Kind.DRIVING), (tilted, Kind.DRIVING), (tilted, Kind.REFERENCE)]
        ):
            stream.picture(sequence, picture, kind)
            reply = stream.rendered()
            away[reply.sequence] = np.abs(pixels(reply.payload) - wanted).mean()
    assert away[0] < 0.5  # the first frame serves until there is a reference
    assert away[1] > 1
    assert away[2] < 0.5


def test_frames_without_a_face_are_reported(server: Server, avatar_id: str) -> None:
    with raw_stream(server.host, avatar_id) as stream:
        stream.hello()
        for count, sequence in enumerate((7, 8), start=1):
            stream.picture(sequence, noise())
            while True:
                newest, stats = stream.stats()
                if stats.lost_face == count:
                    break
            assert newest == sequence
            assert stats.rendered == 0
        # The stream goes on, and a lost frame takes no place in the window.
        stream.numbers(9)
        assert stream.rendered().sequence == 9


def test_no_more_than_the_window_is_unacknowledged(server: Server, avatar_id: str) -> None:
    with raw_stream(server.host, avatar_id) as stream:
        assert stream.hello(Hello(window=3))["window"] == 3
        for sequence in range(3):
            stream.numbers(sequence)
            assert stream.rendered().sequence == sequence
        for sequence in range(3, 20):
            stream.numbers(sequence)
        with pytest.raises(TimeoutError):
            stream.rendered(2.5)
        stream.acknowledge(0)
        assert stream.rendered().sequence == 19
        with pytest.raises(TimeoutError):
            stream.rendered(2.5)


def test_newest_frame_wins_and_the_others_are_counted(server: Server, avatar_id: str) -> None:
    with raw_stream(server.host, avatar_id) as stream:
        stream.hello(Hello(window=1))
        stream.numbers(0)
        assert stream.rendered().sequence == 0
        for sequence in range(1, 51):
            stream.numbers(sequence)
        stream.acknowledge(0)
        reply = stream.rendered()
        while reply.sequence != 50:  # the acknowledgement may overtake the last ones
            stream.acknowledge(reply.sequence)
            reply = stream.rendered()
        while True:
            _, stats = stream.stats()
            if stats.received == 51 and stats.rendered + stats.dropped == 51:
                break
    assert stats.dropped >= 45


def resident(server: Server) -> int:
    status = Path(f"/proc/{server.process.pid}/status")
    if not status.exists():
        pytest.skip("needs Linux's /proc")
    found = re.search(r"VmRSS:\s+(\d+) kB", status.read_text())
    assert found
    return int(found[1]) * 1024


def test_memory_is_flat_when_nothing_is_acknowledged(server: Server, avatar_id: str) -> None:
    picture = noise(768)
    assert len(picture) > 400_000
    with raw_stream(server.host, avatar_id) as stream:
        stream.hello(Hello(window=1))
        stream.numbers(0)
        stream.rendered()
        for sequence in range(1, 21):  # warms the buffers
            stream.picture(sequence, picture)
        time.sleep(1)
        before = resident(server)
        for sequence in range(21, 321):
            stream.picture(sequence, picture)
        # All have arrived when the counts say so.
        while True:
            _, stats = stream.stats()
            if stats.received == 321:
                break
        grown = resident(server) - before
    assert stats.dropped == 319
    assert grown < 300 * len(picture) / 5, f"{grown / 2**20:.0f} MiB"


def test_a_reader_that_acknowledges_but_does_not_read_stops_the_rendering(
    server: Server, client: httpx.Client, avatar_id: str
) -> None:
    """Then only the socket's buffers are left to hold the frames back."""
    link = socket.socket()
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    host, port = server.host.split(":")
    link.connect((host, int(port)))
    url = f"ws://{server.host}/v1/avatars/{avatar_id}/stream"
    with connect(url, sock=link, compression=None, max_size=None, max_queue=1) as opened:
        stream = RawStream(opened)
        stream.hello(Hello(StreamOutput("png", 1024, "source"), window=1))
        sequence = 0

        def ask() -> None:
            nonlocal sequence
            stream.numbers(sequence)
            # Whichever of the latest was rendered; an acknowledgement of another has no effect.
            for shown in range(max(0, sequence - 30), sequence):
                stream.acknowledge(shown)
            sequence += 1
            time.sleep(0.1)

        count = -1.0
        still = time.monotonic()
        deadline = still + 120
        while time.monotonic() - still < 6:
            assert time.monotonic() < deadline, "the service renders for ever"
            ask()
            if (now := frames(client, "rendered")) != count:
                count, still = now, time.monotonic()
        # It was the reader: reading lets the service go on.
        while frames(client, "rendered") == count:
            stream.rendered()
            ask()


@pytest.mark.parametrize(
    ("first", "code", "problem"),
    [
        ('{"type":"hello","versions":[2]}', 1008, "unsupported_version"),
        ('{"type":"hello","versions":[1],"window":99}', 1008, "protocol_error"),
        ("[", 1008, "protocol_error"),
        (b"\xc7\x01", 1008, "protocol_error"),
    ],
    ids=["version", "range", "json", "binary"],
)
def test_wrong_hello_is_refused(
    server: Server, avatar_id: str, first: str | bytes, code: int, problem: str
) -> None:
    with raw_stream(server.host, avatar_id) as stream:
        stream.socket.send(first)
        assert stream.ending() == (code, problem)


def with_byte(data: bytes, place: int, value: int) -> bytes:
    return data[:place] + bytes([value]) + data[place + 1 :]


ACK = wire.pack(Message(Kind.ACK, Codec.NONE, 0, 0, b""))
NUMBERS = wire.pack(
    Message(Kind.COEFFICIENTS, Codec.NONE, 0, 0, wire.pack_coefficients(coefficients()))
)
# A header of a JPEG and nothing after it.
DAMAGED = wire.pack(Message(Kind.DRIVING, Codec.JPEG, 0, 0, noise(64)[:200]))


@pytest.mark.parametrize(
    ("message", "code", "problem"),
    [
        ("text", 1008, "protocol_error"),
        (b"", 1008, "protocol_error"),
        (ACK[:-1], 1008, "protocol_error"),
        (with_byte(ACK, 1, 2), 1008, "unsupported_version"),
        (with_byte(ACK, 2, Kind.RENDERED), 1008, "protocol_error"),
        (NUMBERS[:24] + b"\xff" * 4 + NUMBERS[28:], 1008, "invalid_coefficients"),
        (DAMAGED, 1008, "invalid_image"),
    ],
    ids=["text", "empty", "short", "version", "direction", "nan", "damaged"],
)
def test_broken_message_ends_the_stream(
    server: Server, avatar_id: str, message: str | bytes, code: int, problem: str
) -> None:
    with raw_stream(server.host, avatar_id) as stream:
        stream.hello()
        stream.socket.send(message)
        assert stream.ending() == (code, problem)


def test_too_big_a_message_ends_the_stream(
    server: Server, client: httpx.Client, avatar_id: str
) -> None:
    with raw_stream(server.host, avatar_id) as stream:
        stream.hello()
        # The server closes while the rest is still on its way: the system may drop the close
        # frame together with the connection (1006).
        with suppress(ConnectionClosed):
            stream.socket.send(bytes(3 * 2**20))
        assert stream.ending()[0] in (1009, 1006)
    assert client.get("/health/ready").status_code == 200


def test_unknown_avatar(server: Server) -> None:
    with raw_stream(server.host, "0" * 32) as stream:
        assert stream.ending() == (4404, "avatar_not_found")


def test_stream_ends_when_its_avatar_is_deleted(server: Server, client: httpx.Client) -> None:
    identifier = upload(client)
    with raw_stream(server.host, identifier) as stream:
        stream.hello()
        stream.numbers(0)
        stream.rendered()
        assert client.delete(f"/v1/avatars/{identifier}").status_code == 204
        assert stream.ending() == (4404, "avatar_not_found")


def test_stream_ends_when_its_avatar_expires(server: Server, client: httpx.Client) -> None:
    identifier = upload(client, lifetime=3)
    with raw_stream(server.host, identifier) as stream:
        stream.hello()
        assert stream.ending() == (4410, "avatar_expired")
    with raw_stream(server.host, identifier) as stream:
        assert stream.ending() == (4410, "avatar_expired")


def test_foreign_page_is_refused(server: Server, avatar_id: str) -> None:
    for origin in ("https://evil.example", "null", f"http://{server.host}.evil.example"):
        with raw_stream(server.host, avatar_id, headers={"Origin": origin}) as stream:
            assert stream.ending() == (1008, "forbidden")
    with raw_stream(server.host, avatar_id, headers={"Origin": f"http://{server.host}"}) as stream:
        assert stream.hello()["type"] == "hello"


def test_client_that_vanishes_leaves_nothing_behind(
    server: Server, client: httpx.Client, avatar_id: str
) -> None:
    wait_for_no_stream(client)  # the last test's has only just been closed
    for _ in range(3):
        with raw_stream(server.host, avatar_id) as stream:
            stream.hello()
            stream.numbers(0)
            assert open_streams(client) == 1
            stream.socket.socket.shutdown(socket.SHUT_RDWR)  # no close frame
        wait_for_no_stream(client)


def wait_for_no_stream(client: httpx.Client) -> None:
    deadline = time.monotonic() + SECONDS
    while open_streams(client):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_the_document_names_every_type_close_code_and_field() -> None:
    text = (PORTRAIT.parents[1] / "docs" / "streaming.md").read_text()
    for kind in Kind:
        assert f"| {kind.value} | {kind.name} |" in text
    for close_code in {1008, 1009, *CLOSE_CODES.values()}:
        assert f"\n| {close_code} | " in text
    for field in dataclasses.fields(Hello):
        assert f"`{field.name}" in text
    for field in dataclasses.fields(StreamOutput):
        assert f"`output.{field.name}`" in text
    examples = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    assert Hello.from_json(examples[0]) == Hello()
    assert Welcome.of(json.loads(examples[1])).output == StreamOutput()
