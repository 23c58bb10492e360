"""More clients than there is room for, and clients that leave."""

from __future__ import annotations

import asyncio
import socket
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import httpx
import pytest
from server_process import PORTRAIT, Server, start_server

CLIENTS = 64
TIMEOUT = 180  # far longer than any answer may take, even on a busy machine


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("tiny")
    with start_server(folder, encode_queue=1, render_queue=2, max_batch=2) as running:
        yield running


@pytest.fixture(scope="module")
def path(tiny: Server) -> str:
    with tiny.client() as client:
        answer = client.post("/v1/avatars", content=PORTRAIT.read_bytes())
        assert answer.status_code == 201, answer.text
        return str(answer.headers["Location"])


def at_once(
    server: Server, count: int, method: str, path: str, **more: Any
) -> list[httpx.Response]:
    async def run() -> list[httpx.Response]:
        limits = httpx.Limits(max_connections=count)
        async with httpx.AsyncClient(base_url=server.url, timeout=TIMEOUT, limits=limits) as client:
            calls = [client.request(method, path, **more) for _ in range(count)]
            return list(await asyncio.wait_for(asyncio.gather(*calls), TIMEOUT))

    return asyncio.run(run())


def test_64_clients_none_hangs(tiny: Server, path: str) -> None:
    data = PORTRAIT.read_bytes()
    for request in (
        {"path": f"{path}/render", "json": {"arkit": {"jawOpen": 0.5}}},
        {"path": f"{path}/drive", "content": data},
        {"path": "/v1/track", "content": data},
        {"path": "/v1/avatars", "content": data},
    ):
        answers = at_once(tiny, CLIENTS, "POST", **request)
        counted = Counter(answer.status_code for answer in answers)
        assert set(counted) <= {200, 201, 503}, counted
        assert counted[200] + counted[201] >= 1
        assert counted[503] >= 1, "the tiny queues were never full"
        for answer in answers:
            if answer.status_code == 503:
                assert answer.json()["code"] == "overloaded"
                assert int(answer.headers["Retry-After"]) >= 1


def test_a_batch_waits_for_room_behind_its_first_frame(tiny: Server, path: str) -> None:
    async def run() -> httpx.Response:
        async with httpx.AsyncClient(base_url=tiny.url, timeout=TIMEOUT) as client:
            body = {"frames": [{}] * 8, "output": {"size": 16}}
            batch = asyncio.create_task(client.post(f"{path}/batch", json=body))
            while not batch.done():
                await asyncio.gather(*(client.post(f"{path}/render") for _ in range(4)))
            return await batch

    answer = asyncio.run(asyncio.wait_for(run(), TIMEOUT))
    if answer.status_code == 200:
        assert answer.content.count(b"Content-Type: image/png") == 8
    else:
        assert answer.status_code == 503  # no room for the first frame


def test_work_of_clients_that_left_is_skipped(tiny: Server, path: str) -> None:
    body = b'{"frames": [' + b"{}," * 49 + b"{}]}"
    for target, content, kind in (
        (f"{path}/batch", body, "application/json"),
        (f"{path}/render", b"{}", "application/json"),
        ("/v1/avatars", PORTRAIT.read_bytes(), "image/png"),
    ):
        for _ in range(6):
            leave_early(tiny, target, content, kind)
    deadline = time.monotonic() + 60
    with tiny.client() as client:
        while metric(client, IN_FLIGHT) > 1:  # this one
            assert time.monotonic() < deadline, "requests of clients that left are still there"
            time.sleep(0.2)
        assert client.post(f"{path}/render").status_code == 200
        assert "Traceback" not in tiny.logs()


def test_an_upload_whose_client_left_is_not_encoded(tiny: Server, path: str) -> None:
    """One upload is being encoded, one waits: the second's client leaves, and it is skipped."""
    with tiny.client() as client:
        before = metric(client, CANCELLED)
        deadline = time.monotonic() + TIMEOUT
        while metric(client, CANCELLED) == before:
            assert time.monotonic() < deadline, "no upload was skipped"
            with ExitStack() as links:
                for _ in range(2):
                    links.enter_context(uploading(tiny))
                while metric(client, WAITING) == 0 and metric(client, IN_FLIGHT) > 1:
                    time.sleep(0.01)
            while metric(client, IN_FLIGHT) > 1:
                time.sleep(0.05)
            # Behind the one that has begun, the skipped one makes room for this one.
            answer = client.post("/v1/avatars", content=PORTRAIT.read_bytes())
            assert answer.status_code == 201, answer.text


CANCELLED = 'cvthead_cancelled_total{queue="encode"}'
WAITING = 'cvthead_queue_depth{queue="encode"}'
IN_FLIGHT = "cvthead_requests_in_flight"


@contextmanager
def uploading(server: Server) -> Iterator[None]:
    """A client that has sent its portrait and waits; it leaves at the end."""
    host, port = server.host.split(":")
    data = PORTRAIT.read_bytes()
    head = f"POST /v1/avatars HTTP/1.1\r\nHost: {server.host}\r\nContent-Length: {len(data)}"
    with socket.create_connection((host, int(port))) as link:
        link.sendall(f"{head}\r\n\r\n".encode() + data)
        yield


def leave_early(server: Server, path: str, content: bytes, kind: str) -> None:
    host, port = server.host.split(":")
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(
            f"POST {path} HTTP/1.1\r\nHost: {server.host}\r\nContent-Type: {kind}\r\n"
            f"Content-Length: {len(content)}\r\n\r\n".encode()
            + content
        )
        time.sleep(0.05)


def metric(client: httpx.Client, series: str) -> float:
    return float(client.get("/metrics").text.partition(f"\n{series} ")[2].split()[0])
