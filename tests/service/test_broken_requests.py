"""Handshakes that are no WebSocket's and bodies that are no HTTP/1.1, over a real socket."""

from __future__ import annotations

import re
import socket
from typing import Any

import pytest
from raw_problem import checked_problem
from server_process import Server

STREAM = b"/v1/avatars/0/stream"
UPGRADE = b"Host: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
KEY = b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
VERSION = b"Sec-WebSocket-Version: 13\r\n"
CHUNKED = b"Host: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"


def answers(server: Server, *parts: bytes) -> list[tuple[list[str], str]]:
    """Header lines and body of each answer on one connection; a part is sent once the service
    has begun with the one before."""
    host, port = server.host.split(":")
    with socket.create_connection((host, int(port)), timeout=60) as link:
        for number, part in enumerate(parts):
            if number:
                wait_for_requests(server, 2)
            link.sendall(part)
        data = b""
        while received := link.recv(65536):
            data += received
    found = []
    for text in re.split(r"(?=HTTP/1\.1 \d)", data.decode())[1:]:
        head, _, body = text.partition("\r\n\r\n")
        found.append((head.lower().split("\r\n"), body))
    return found


def wait_for_requests(server: Server, count: int) -> None:
    """Until as many are being answered, this one among them."""
    with server.client() as client:
        while f"cvthead_requests_in_flight {count}.0" not in client.get("/metrics").text:
            pass


def problem(found: list[tuple[list[str], str]], code: str) -> tuple[dict[str, Any], list[str]]:
    """The one problem that was answered, and its header lines."""
    ((lines, body),) = found
    said = checked_problem(lines, body, code)
    assert f"x-request-id: {said['request_id']}" in lines
    return said, lines


@pytest.mark.parametrize("path", [b"/v1/nothing", b"/v1/avatars", b"/"])
def test_a_handshake_where_no_stream_is(server: Server, path: bytes) -> None:
    asked = b"GET " + path + b" HTTP/1.1\r\n" + UPGRADE + KEY + VERSION + b"\r\n"
    said, _ = problem(answers(server, asked), "not_found")
    assert said["instance"] == path.decode()
    assert "without completing" not in server.logs()


@pytest.mark.parametrize(
    "fields",
    [VERSION, KEY, KEY + b"Sec-WebSocket-Version: 99\r\n", VERSION + b"Sec-WebSocket-Key: a\r\n"],
)
def test_a_handshake_that_is_none(server: Server, fields: bytes) -> None:
    asked = b"GET " + STREAM + b"?ticket=secret HTTP/1.1\r\n" + UPGRADE + fields + b"\r\n"
    said, lines = problem(answers(server, asked), "malformed_request")
    assert "Sec-WebSocket" in said["detail"]
    assert said["instance"] == STREAM.decode()
    assert "sec-websocket-version: 13" in lines


def test_a_handshake_with_another_method(server: Server) -> None:
    asked = b"POST " + STREAM + b" HTTP/1.1\r\n" + UPGRADE + KEY + VERSION + b"\r\n"
    _, lines = problem(answers(server, asked), "method_not_allowed")
    assert "allow: GET".lower() in lines


@pytest.mark.parametrize("more", [b"X-Long: " + b"a" * 9000 + b"\r\n", b"X-Many: 1\r\n" * 200])
def test_a_handshake_with_more_headers_than_the_library_takes(server: Server, more: bytes) -> None:
    asked = b"GET " + STREAM + b" HTTP/1.1\r\n" + UPGRADE + KEY + VERSION + more + b"\r\n"
    problem(answers(server, asked), "headers_too_large")


@pytest.mark.parametrize("path", [b"/v1/track", b"/v1/avatars"])
@pytest.mark.parametrize("before", [b"", b"5\r\nhello\r\n"])
def test_a_broken_chunk_is_answered_under_the_requests_id(
    server: Server, path: bytes, before: bytes
) -> None:
    head = b"POST " + path + b" HTTP/1.1\r\nX-Request-ID: broken-chunk\r\n" + CHUNKED
    for parts in ([head + before + b"zz\r\n"], [head + before, b"zz\r\n"]):
        said, _ = problem(answers(server, *parts), "malformed_body")
        assert said["request_id"] == "broken-chunk"
        assert said["instance"] == path.decode()


def test_a_broken_body_that_nobody_reads_adds_no_second_answer(server: Server) -> None:
    asked = b"POST /v1/nothing HTTP/1.1\r\n" + CHUNKED + b"zz\r\n"
    problem(answers(server, asked), "not_found")
