"""The running service: health, metrics, logs, limits on the wire, keys, and stopping."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
from server_process import PORTRAIT, ROOT, Server, start_server

from cvthead.cli.main import main
from service.cli import listening

ALICE, BOB = "alice-0123456789", "bob-9876543210-x"
BODY_LIMIT = 1_000_000


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with two keys, a small body limit and a foreign page that may call it."""
    with start_server(
        tmp_path_factory.mktemp("guarded"),
        keys=f"alice:{ALICE},bob:{BOB}",
        max_body_bytes=BODY_LIMIT,
        cors_origins="https://friend.example",
    ) as running:
        yield running


def lines(server: Server) -> list[dict[str, object]]:
    return [json.loads(line) for line in server.logs().splitlines()]


def test_health(client: httpx.Client) -> None:
    assert client.get("/health/live").json() == {"status": "live"}
    assert client.get("/health/ready").json() == {"status": "ready"}


def test_models_say_what_is_loaded(client: httpx.Client) -> None:
    (model,) = client.get("/v1/models").json()["items"]
    assert model["preset"] == "open"
    assert len(model["fingerprint"]) == 16
    assert (model["shape"], model["expression"], len(model["pose"])) == (100, 50, 5)
    assert len(model["arkit"]) == 52
    assert model["licences"]["code"] == "Apache-2.0"


def test_metrics_count_requests_and_name_no_avatar(client: httpx.Client, avatar_id: str) -> None:
    before = client.get("/metrics").text
    assert client.post(f"/v1/avatars/{avatar_id}/render", json={}).status_code == 200
    answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    series = 'cvthead_requests_total{method="POST",route="/v1/avatars/{avatar_id}/render"'
    assert count(answer.text, series) == count(before, series) + 1
    assert count(answer.text, 'cvthead_stage_seconds_count{stage="paint"}') >= 1
    assert count(answer.text, "process_resident_memory_bytes") > 1e6
    assert avatar_id not in answer.text


def count(text: str, series: str) -> float:
    return sum(float(line.split()[-1]) for line in text.splitlines() if line.startswith(series))


def test_the_log_has_the_request_but_no_id_and_no_numbers(
    client: httpx.Client, server: Server, avatar_id: str
) -> None:
    body = {"expression": [0.123456789] * 50}
    headers = {"X-Request-ID": "render-for-the-log"}
    path = f"/v1/avatars/{avatar_id}/render"
    assert client.post(path, json=body, headers=headers).status_code == 200
    found = [line for line in lines(server) if line.get("request_id") == "render-for-the-log"]
    assert [line["event"] for line in found] == ["request"]
    assert (found[0]["method"], found[0]["status"]) == ("POST", 200)
    assert avatar_id not in server.logs()
    assert "0.1234" not in server.logs()
    assert "IHDR" not in server.logs()


def test_unknown_paths_on_the_wire(client: httpx.Client) -> None:
    for method, path, code in (
        ("GET", "/v1/nothing", "not_found"),
        ("GET", "/static/../settings.py", "not_found"),
        ("DELETE", "/v1/models", "method_not_allowed"),
    ):
        answer = client.request(method, path)
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["code"] == code


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        ("/v1/avatars", "GET, POST"),
        ("/v1/avatars/0", "GET, DELETE"),
        ("/v1/avatars/0/render", "POST"),
        ("/v1/models", "GET"),
        ("/", "GET, HEAD"),
    ],
)
def test_allow_lists_all_methods_of_the_path(client: httpx.Client, path: str, allowed: str) -> None:
    answer = client.put(path)
    assert (answer.status_code, answer.headers["allow"]) == (405, allowed)


def test_openapi_says_what_needs_a_key(client: httpx.Client) -> None:
    schema = client.get("/openapi.json").json()
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            guarded = "unauthorized" in str(operation["responses"].get("401"))
            assert bool(operation.get("security")) is guarded, f"{method} {path}"
    assert schema["paths"]["/metrics"]["get"]["security"]


def test_openapi_has_what_the_core_says_of_a_face(client: httpx.Client) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    content = paths["/v1/avatars"]["post"]["responses"]["422"]["content"]
    examples = content["application/problem+json"]["examples"]
    assert {"no_face", "several_faces", "face_turned_away", "face_error"} <= examples.keys()


def test_openapi_documents_problems_everywhere(client: httpx.Client) -> None:
    schema = client.get("/openapi.json").json()
    assert "ProblemBody" in schema["components"]["schemas"]
    assert "HTTPValidationError" not in schema["components"]["schemas"]
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            place = f"{method} {path}"
            assert operation["responses"]["default"]["content"].keys() == {
                "application/problem+json"
            }, place
            assert operation.get("summary"), place
            for status, answer in operation["responses"].items():
                if status.isdecimal() and int(status) >= 400:
                    assert "application/problem+json" in answer["content"], f"{place} {status}"
                    assert answer["description"], f"{place} {status}"


def test_an_open_loopback_service_refuses_other_host_names(client: httpx.Client) -> None:
    answer = client.get("/v1/models", headers={"Host": "evil.example"})
    assert (answer.status_code, answer.json()["code"]) == (403, "forbidden")


def test_keys_guard_everything_but_the_open_paths(guarded: Server) -> None:
    with guarded.client() as nobody, guarded.client(ALICE) as alice:
        for path in ("/health/live", "/health/ready", "/v1/models", "/openapi.json"):
            assert nobody.get(path).status_code == 200, path
        schema = nobody.get("/openapi.json").json()
        for path, operations in schema["paths"].items():
            if path.startswith("/health/") or path == "/v1/models":
                continue
            for method in operations:
                url = path.replace("{avatar_id}", "0" * 32)
                answer = nobody.request(method, url)
                assert answer.json()["code"] == "unauthorized", f"{method} {path}"
        assert alice.get("/v1/avatars").status_code == 200
        assert alice.get("/metrics").status_code == 200


def test_tickets_need_a_key(guarded: Server) -> None:
    with guarded.client(ALICE) as alice:
        answer = alice.post("/v1/tickets")
        assert answer.status_code == 201
        assert answer.json()["expires_in"] == 30
        assert answer.headers["cache-control"] == "no-store"
        assert answer.json()["ticket"] != alice.post("/v1/tickets").json()["ticket"]


def test_secrets_are_not_logged(guarded: Server) -> None:
    with guarded.client(ALICE) as alice:
        ticket = alice.post("/v1/tickets").json()["ticket"]
        alice.get("/v1/avatars", params={"ticket": ticket, "key": BOB})
        alice.get("/metrics")
    written = guarded.logs() + "".join(guarded.output)
    for secret in (ALICE, BOB, ticket):
        assert secret not in written


def test_bodies_over_the_limit_on_the_wire(guarded: Server) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(40):
            yield bytes(100_000)

    headers = {"Content-Type": "image/png"}
    with guarded.client(ALICE) as alice:
        for content in (bytes(4 * BODY_LIMIT), chunks()):
            answer = alice.post("/v1/avatars?consent=true", content=content, headers=headers)
            assert answer.json()["code"] == "body_too_large"
            assert answer.status_code == 413


def test_endless_chunks_end_with_the_limit(guarded: Server) -> None:
    """A client that never stops sending is cut off, however patient it is."""
    with connected(guarded) as wire:
        wire.sendall(head(guarded, ALICE, "Transfer-Encoding: chunked"))
        with pytest.raises(OSError, match=r"reset|pipe"):
            send_chunks(wire, 50 * BODY_LIMIT)
    with guarded.client(ALICE) as alice:
        assert alice.get("/v1/avatars").status_code == 200


def test_cors_on_the_wire(guarded: Server) -> None:
    asked = {"Access-Control-Request-Method": "POST", "Origin": "https://friend.example"}
    with guarded.client() as nobody:
        answer = nobody.options("/v1/avatars", headers=asked)
        assert answer.headers["access-control-allow-origin"] == "https://friend.example"
        refused = nobody.options("/v1/avatars", headers=asked | {"Origin": "https://foe.example"})
        assert refused.json()["code"] == "forbidden"
        answer = nobody.get("/v1/models", headers=asked)
        exposed = set(answer.headers["access-control-expose-headers"].split(", "))
        paths = nobody.get("/openapi.json").json()["paths"]
    documented = {
        name
        for operations in paths.values()
        for operation in operations.values()
        for answer in operation["responses"].values()
        for name in answer.get("headers", {})
    }
    assert {"Location", "X-Digital-Source-Type", "Idempotency-Replayed"} <= documented
    assert documented - {"Vary"} <= exposed  # which is for caches


def send_chunks(wire: socket.socket, total: int) -> None:
    for _ in range(total // 0x10000):
        wire.sendall(b"10000\r\n" + bytes(0x10000) + b"\r\n")


def connected(server: Server) -> socket.socket:
    host, port = server.host.split(":")
    return socket.create_connection((host, int(port)), timeout=120)


def head(server: Server, key: str | None, *more: str) -> bytes:
    fields = [
        "POST /v1/avatars?consent=true HTTP/1.1",
        f"Host: {server.host}",
        "Content-Type: image/png",
        *([f"Authorization: Bearer {key}"] if key else []),
        *more,
    ]
    return "\r\n".join([*fields, "", ""]).encode()


def test_sigterm_finishes_what_was_accepted(tmp_path: Path) -> None:
    portrait = PORTRAIT.read_bytes()
    with start_server(tmp_path) as server, server.client() as client:
        # The store can be lost and come back.
        moved = server.store.rename(tmp_path / "moved")
        lost = client.get("/health/ready")
        assert (lost.status_code, lost.json()["code"]) == (503, "not_ready")
        moved.rename(server.store)
        assert client.get("/health/ready").status_code == 200

        with connected(server) as wire:
            wire.sendall(head(server, None, f"Content-Length: {len(portrait)}"))
            wire.sendall(portrait[:1000])
            wait_until(lambda: count(client.get("/metrics").text, IN_FLIGHT) == 2)
            server.terminate()
            wait_until(lambda: client.get("/health/ready").status_code == 503)
            assert client.get("/health/ready").json()["code"] == "draining"
            assert client.get("/health/live").status_code == 200
            refused = client.get("/v1/models")
            assert refused.json()["code"] == "draining"
            assert refused.headers["connection"] == "close"
            wire.sendall(portrait[1000:])
            status, answer = read_answer(wire)
        assert status == 201
        assert server.wait() == 0
        assert "Traceback" not in server.logs()
        events = [line["event"] for line in lines(server)]
        assert events[0] == "started"
        assert events[-1] == "stopped"
        assert list(server.store.glob(f"{answer['id']}*"))


IN_FLIGHT = "cvthead_requests_in_flight"


def wait_until(true: Callable[[], bool], seconds: float = 30) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def read_answer(wire: socket.socket) -> tuple[int, dict[str, object]]:
    """Status and JSON body of an answer that ends with the connection."""
    data = b""
    while part := wire.recv(65536):
        data += part
    start, _, body = data.partition(b"\r\n\r\n")
    return int(start.split()[1]), json.loads(body)


def test_sigterm_under_load_loses_no_accepted_request(tmp_path: Path) -> None:
    """Every request is answered, with success or with ``draining``, until nobody listens."""

    def render_until_refused(url: str) -> list[int]:
        statuses: list[int] = []
        with server.client() as client:
            while 503 not in statuses:
                try:
                    statuses.append(client.post(url, json={}).status_code)
                except httpx.ConnectError:
                    break  # the socket is closed: not accepted
        return statuses

    with start_server(tmp_path) as server, ThreadPoolExecutor(6) as pool:
        with server.client() as client:
            headers = {"Content-Type": "image/png"}
            created = client.post("/v1/avatars", content=PORTRAIT.read_bytes(), headers=headers)
            url = f"/v1/avatars/{created.json()['id']}/render"
            assert client.post(url, json={}).status_code == 200
            running = [pool.submit(render_until_refused, url) for _ in range(6)]
            series = "cvthead_requests_total"
            wait_until(lambda: count(client.get("/metrics").text, series) > 20)
            server.terminate()
        answers = [future.result(timeout=60) for future in running]
        assert server.wait() == 0
    assert all(200 in statuses for statuses in answers)
    assert set().union(*answers) <= {200, 503}
    abandoned = [line["abandoned"] for line in lines(server) if line["event"] == "stopped"]
    assert abandoned == [0]


def test_a_second_signal_ends_it_at_once(tmp_path: Path) -> None:
    with start_server(tmp_path, drain_seconds=600) as server, connected(server) as wire:
        wire.sendall(head(server, None, "Content-Length: 1000"))
        with server.client() as client:
            wait_until(lambda: count(client.get("/metrics").text, IN_FLIGHT) == 2)
            server.process.send_signal(signal.SIGINT)
            wait_until(lambda: client.get("/health/ready").status_code == 503)
        server.terminate()
        assert server.wait() == 0


def test_the_printed_curl_lines_work_as_pasted(server: Server, tmp_path: Path) -> None:
    if not shutil.which("curl"):
        pytest.skip("curl is not installed")
    script = "".join(line for line in server.output if line.startswith("  "))
    subprocess.run(["bash", "-e", "-c", script], cwd=tmp_path, check=True, timeout=120)
    assert (tmp_path / "frame.png").read_bytes().startswith(b"\x89PNG")


def test_with_keys_the_curl_lines_read_the_key_from_a_variable(guarded: Server) -> None:
    script = "".join(line for line in guarded.output if line.startswith("  "))
    assert 'Bearer $KEY"' in script


def test_no_open_network_without_keys(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--host", "0.0.0.0", "--port", "0"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("cvthead: error: settings: 0.0.0.0 can be reached")
    assert error.count("\n") == 1


def test_a_taken_port_is_told_before_anything_is_loaded(
    server: Server, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    port = server.host.split(":")[1]
    assert main(["serve", "--port", port, "--store", str(tmp_path / "store")]) == 2
    assert "cannot listen" in capsys.readouterr().err
    assert not (tmp_path / "store").exists()


def test_serve_tells_what_is_not_installed(tmp_path: Path) -> None:
    """The core works without the packages of the service."""
    (tmp_path / "fastapi.py").write_text("raise ModuleNotFoundError(name='fastapi')")
    process = subprocess.run(
        [sys.executable, "-m", "cvthead.cli.main", "serve", "--port", "0"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert process.returncode == 2
    assert process.stderr.startswith("cvthead: error: the service needs the package fastapi")


def test_connections_send_at_once() -> None:
    """The sockets of a server are made from this one; asyncio sets TCP_NODELAY by its protocol."""
    with listening("127.0.0.1", 0) as bound:
        assert bound.proto == socket.IPPROTO_TCP
        bound.listen()
        with socket.create_connection(bound.getsockname()):
            accepted, _ = bound.accept()
            with accepted:
                assert accepted.proto == socket.IPPROTO_TCP
