"""Fixtures of the service's tests: one real server process, shared where settings allow it."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest
from server_process import PORTRAIT, Server, start_server


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One server without keys for all tests that change no settings."""
    with start_server(tmp_path_factory.mktemp("server")) as running:
        yield running


@pytest.fixture(scope="session")
def client(server: Server) -> Iterator[httpx.Client]:
    with server.client() as connected:
        yield connected


@pytest.fixture(scope="session")
def avatar_id(client: httpx.Client) -> str:
    """The sample portrait, uploaded once."""
    answer = client.post(
        "/v1/avatars",
        content=PORTRAIT.read_bytes(),
        headers={"Content-Type": "image/png"},
    )
    assert answer.status_code == 201, answer.text
    identifier: str = answer.json()["id"]
    return identifier
