"""Who may open a stream, and how it ends when the service stops."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass

import httpx
import pytest
from raw_stream import SECONDS, RawStream, raw_stream
from server_process import PORTRAIT, Server, start_server
from websockets.exceptions import InvalidStatus

from cvthead.avatar import Avatar
from cvthead.cache import AvatarCache

KEYS = {"ann": "key-of-ann-0123456789", "bob": "key-of-bob-0123456789"}
FRIEND = "https://friend.example"
TICKET_SECONDS = 2


@dataclass(frozen=True)
class Keyed:
    server: Server
    ann: httpx.Client
    avatar: str
    outdated: str

    def ticket(self) -> str:
        answer = self.ann.post("/v1/tickets")
        assert answer.status_code == 201
        ticket: str = answer.json()["ticket"]
        return ticket


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Keyed]:
    """A server with two keys, one foreign origin, room for two streams."""
    settings = {
        "keys": ",".join(f"{name}:{key}" for name, key in KEYS.items()),
        "websocket_origins": FRIEND,
        "ticket_seconds": TICKET_SECONDS,
        "max_streams": 2,
    }
    folder = tmp_path_factory.mktemp("keyed")
    with start_server(folder, **settings) as server, server.client(KEYS["ann"]) as ann:
        answer = ann.post(
            "/v1/avatars?consent=true",
            content=PORTRAIT.read_bytes(),
            headers={"Content-Type": "image/png"},
        )
        assert answer.status_code == 201, answer.text
        avatar = answer.json()["id"]
        made = Avatar.load(server.store / f"{avatar}.avatar")
        other = dataclasses.replace(made, fingerprint="0" * 16)
        outdated = AvatarCache(server.store).put(other, owner="ann").id
        yield Keyed(server, ann, avatar, outdated)


def bearer(name: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {KEYS[name]}"}


def test_key_opens_a_stream(keyed: Keyed) -> None:
    with raw_stream(keyed.server.host, keyed.avatar, headers=bearer("ann")) as stream:
        assert stream.hello()["avatar"] == keyed.avatar


def test_without_a_key_or_with_a_wrong_one(keyed: Keyed) -> None:
    wrong = {"Authorization": "Bearer key-of-eve-0123456789"}
    for headers, query in (({}, ""), (wrong, ""), ({}, "?ticket=nonsense")):
        with raw_stream(keyed.server.host, keyed.avatar, query, headers) as stream:
            assert stream.ending() == (1008, "unauthorized")


def test_key_in_the_address_is_no_ticket(keyed: Keyed) -> None:
    with raw_stream(keyed.server.host, keyed.avatar, f"?ticket={KEYS['ann']}") as stream:
        assert stream.ending() == (1008, "unauthorized")


def test_ticket_opens_one_stream(keyed: Keyed) -> None:
    query = f"?ticket={keyed.ticket()}"
    with raw_stream(keyed.server.host, keyed.avatar, query) as stream:
        assert stream.hello()["type"] == "hello"
    with raw_stream(keyed.server.host, keyed.avatar, query) as stream:
        assert stream.ending() == (1008, "unauthorized")


def test_ticket_expires(keyed: Keyed) -> None:
    query = f"?ticket={keyed.ticket()}"
    time.sleep(TICKET_SECONDS + 0.5)
    with raw_stream(keyed.server.host, keyed.avatar, query) as stream:
        assert stream.ending() == (1008, "unauthorized")


def test_another_key_does_not_see_the_avatar(keyed: Keyed) -> None:
    with raw_stream(keyed.server.host, keyed.avatar, headers=bearer("bob")) as stream:
        assert stream.ending() == (4404, "avatar_not_found")


def test_avatar_of_other_weights(keyed: Keyed) -> None:
    with raw_stream(keyed.server.host, keyed.outdated, headers=bearer("ann")) as stream:
        assert stream.ending() == (4409, "model_changed")


def test_listed_origin_is_allowed(keyed: Keyed) -> None:
    for origin, allowed in ((FRIEND, True), (f"{FRIEND}.evil", False)):
        headers = bearer("ann") | {"Origin": origin}
        with raw_stream(keyed.server.host, keyed.avatar, headers=headers) as stream:
            if allowed:
                assert stream.hello()["type"] == "hello"
            else:
                assert stream.ending() == (1008, "forbidden")


def test_more_streams_than_allowed(keyed: Keyed) -> None:
    def opened() -> AbstractContextManager[RawStream]:
        return raw_stream(keyed.server.host, keyed.avatar, headers=bearer("ann"))

    with opened() as first, opened() as second:
        first.hello()
        second.hello()
        with opened() as third:
            assert third.ending() == (1013, "overloaded")
    deadline = time.monotonic() + SECONDS
    while True:
        with opened() as stream:
            if stream.hello()["type"] == "hello":
                break
        assert time.monotonic() < deadline


def test_sigterm_closes_streams_with_going_away(keyed: Keyed) -> None:
    """The last test of this file: it stops the server."""
    with raw_stream(keyed.server.host, keyed.avatar, headers=bearer("ann")) as stream:
        stream.hello()
        stream.numbers(0)
        stream.rendered()
        stream.numbers(1)
        keyed.server.terminate()
        assert stream.ending() == (1001, "draining")
        refused = raw_stream(keyed.server.host, keyed.avatar, headers=bearer("ann"))
        with pytest.raises((InvalidStatus, OSError)), refused:
            pass
    assert keyed.server.wait() == 0
