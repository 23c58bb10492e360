"""Requests that come slowly, endlessly or in no HTTP, and answers that nobody reads, over a real
socket."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import httpx
import pytest
from raw_problem import checked_problem
from raw_stream import coefficients, raw_stream
from server_process import PORTRAIT, Server, start_server

SECONDS = 1.5
PAUSE = 0.1
HEAD = b"POST /v1/track HTTP/1.1\r\nHost: localhost\r\n"
BODY = HEAD + b"Content-Type: image/png\r\nContent-Length: 100000\r\n\r\n"


@pytest.fixture(scope="module")
def impatient(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    limits = {"receive_seconds": SECONDS, "send_seconds": SECONDS}
    with start_server(tmp_path_factory.mktemp("slow"), **limits) as running:
        yield running


def opened(server: Server) -> socket.socket:
    host, port = server.host.split(":")
    return socket.create_connection((host, int(port)), timeout=60)


def trickled(link: socket.socket, byte: bytes) -> bytes:
    """What the service answers while bytes come one by one, until it closes."""
    link.settimeout(PAUSE)
    answer, closes = b"", time.monotonic() + 60
    while time.monotonic() < closes:
        try:
            link.sendall(byte)
            while data := link.recv(65536):
                answer += data
            return answer
        except TimeoutError:
            continue
        except ConnectionError:
            return answer
    raise AssertionError("the connection is still open")


def problem(answer: bytes, code: str) -> dict[str, Any]:
    head, _, body = answer.partition(b"\r\n\r\n")
    return checked_problem(head.decode().lower().split("\r\n"), body, code)


@pytest.mark.parametrize(
    ("sent", "byte"), [(HEAD + b"X-Slow: ", b"a"), (b"GET /", b"a"), (BODY, b"a")]
)
def test_a_slow_request_is_answered_408(impatient: Server, sent: bytes, byte: bytes) -> None:
    with opened(impatient) as link:
        link.sendall(sent)
        problem(trickled(link, byte), "request_timeout")


@pytest.mark.parametrize("byte", [b"", b"\n"])
def test_a_connection_that_asks_nothing_is_closed(impatient: Server, byte: bytes) -> None:
    with opened(impatient) as link:
        assert trickled(link, byte) == b""


def test_a_body_that_nobody_reads_cannot_hold_the_connection(impatient: Server) -> None:
    with opened(impatient) as link:
        link.sendall(BODY.replace(b"POST /v1/track", b"POST /v1/nothing"))
        assert trickled(link, b"a").startswith(b"HTTP/1.1 404 ")


def test_what_is_slow_but_in_time_is_served(impatient: Server) -> None:
    portrait = PORTRAIT.read_bytes()
    half = len(portrait) // 2
    head = HEAD + b"Content-Length: %d\r\nConnection: close\r\n\r\n" % len(portrait)
    with opened(impatient) as link:
        for part in (head[:30], head[30:], portrait[:half], portrait[half:]):
            time.sleep(SECONDS / 5)
            link.sendall(part)
        assert link.recv(65536).startswith(b"HTTP/1.1 200 ")


def test_a_stream_may_be_longer(impatient: Server) -> None:
    with impatient.client() as client:
        uploaded = client.post("/v1/avatars", content=PORTRAIT.read_bytes())
    with raw_stream(impatient.host, uploaded.json()["id"]) as opened_stream:
        opened_stream.hello()
        time.sleep(2 * SECONDS)
        opened_stream.numbers(1, coefficients())
        assert opened_stream.rendered().sequence == 1


def test_endless_headers_are_refused(impatient: Server) -> None:
    with opened(impatient) as link:
        link.sendall(HEAD + b"X-Long: " + b"a" * 100_000)
        problem(trickled(link, b"a"), "headers_too_large")


@pytest.mark.parametrize("sent", [b"\x16\x03\x01\x02\x00\x01\x00", b"hello\r\n\r\n"])
def test_what_is_no_http_gets_a_problem(impatient: Server, sent: bytes) -> None:
    with opened(impatient) as link:
        link.sendall(sent)
        problem(link.recv(65536), "malformed_request")


@pytest.mark.parametrize("reads", [False, True])
def test_an_answer_that_nobody_reads_is_given_up(impatient: Server, reads: bool) -> None:
    """And one that is read slowly is sent to its end."""
    with impatient.client() as client:
        uploaded = client.post("/v1/avatars", content=PORTRAIT.read_bytes())
        path = uploaded.json()["links"]["batch"]
        frames = [{"pose": {"global": [0, turn / 100, 0]}} for turn in range(100)]
        body = json.dumps({"frames": frames, "output": {"size": 512}}).encode()
        head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
        kind = f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        with opened(impatient) as link:
            link.sendall(f"{head}{kind}".encode() + body)
            if not reads:
                answering(client, 2)
                answering(client, 1)
            answer, pauses = b"", 10
            with suppress(ConnectionError):
                while data := link.recv(2**20):
                    answer += data
                    time.sleep(SECONDS / 5 if pauses else 0)
                    pauses = max(0, pauses - 1)
    assert answer.endswith(b"0\r\n\r\n") is reads


def answering(client: httpx.Client, requests: int) -> None:
    """Wait until as many requests are being answered, the one that asks among them."""
    closes = time.monotonic() + 60
    while f"cvthead_requests_in_flight {requests}.0" not in client.get("/metrics").text:
        assert time.monotonic() < closes, f"not {requests} in flight"
        time.sleep(PAUSE)
