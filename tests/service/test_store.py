"""What the store remembers: restarts, owners, expiry, other weights, its limit."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from made_pictures import saved
from PIL import Image
from server_process import PORTRAIT, Server, start_server

ANN, BOB = "ann-0123456789abcdef", "bob-0123456789abcdef"
KEYS = f"ann:{ANN},bob:{BOB}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("store")


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Server]:
    with start_server(folder, keys=KEYS, store_max_avatars=4, memory_bytes=0) as running:
        yield running


@pytest.fixture(scope="module")
def ann(server: Server) -> Iterator[httpx.Client]:
    with server.client(ANN) as client:
        yield client


@pytest.fixture(scope="module")
def bob(server: Server) -> Iterator[httpx.Client]:
    with server.client(BOB) as client:
        yield client


def create(client: httpx.Client, **more: Any) -> httpx.Response:
    more["params"] = {"consent": True} | more.get("params", {})
    return client.post("/v1/avatars", content=PORTRAIT.read_bytes(), **more)


def code_of(answer: httpx.Response) -> tuple[int, str]:
    return answer.status_code, answer.json().get("code", "")


@pytest.fixture
def path(ann: httpx.Client) -> Iterator[str]:
    answer = create(ann)
    assert answer.status_code == 201, answer.text
    yield answer.headers["Location"]
    ann.delete(answer.headers["Location"])


def damage(server: Server, client: httpx.Client, path: str, old: bytes, new: bytes) -> None:
    """Change an avatar's file, and push it out of the memory."""
    file = server.store / f"{path.rpartition('/')[2]}.avatar"
    data = file.read_bytes()
    assert old in data
    file.write_bytes(data.replace(old, new))
    client.delete(create(client).headers["Location"])


def uses(client: httpx.Client, path: str) -> list[httpx.Response]:
    return [
        client.get(path),
        client.get(f"{path}/preview"),
        client.post(f"{path}/render"),
        client.post(f"{path}/drive", content=PORTRAIT.read_bytes()),
        client.post(f"{path}/batch", json={"frames": [{}]}),
    ]


def test_keys_say_consent(ann: httpx.Client) -> None:
    for params in ({"consent": False}, {"consent": "no"}):
        assert code_of(create(ann, params=params)) == (422, "consent_required")


def test_without_a_key_nothing_is_read(server: Server, path: str) -> None:
    with server.client() as nobody:
        answers = [*uses(nobody, path), nobody.get("/v1/avatars"), create(nobody)]
        answers += [nobody.post("/v1/track", content=b"x"), nobody.delete(path)]
        assert {code_of(answer) for answer in answers} == {(401, "unauthorized")}


def test_two_keys_are_isolated(ann: httpx.Client, bob: httpx.Client, path: str) -> None:
    for answer in [*uses(bob, path), bob.delete(path)]:
        assert code_of(answer) == (404, "avatar_not_found")
    assert bob.get("/v1/avatars").json()["items"] == []
    assert [item["links"]["self"] for item in ann.get("/v1/avatars").json()["items"]] == [path]
    assert all(answer.status_code == 200 for answer in uses(ann, path))
    key = {"Idempotency-Key": "same-for-both"}
    mine, theirs = create(ann, headers=key), create(bob, headers=key)
    assert (mine.status_code, theirs.status_code) == (201, 201)
    assert mine.json()["id"] != theirs.json()["id"]
    ann.delete(mine.headers["Location"])
    bob.delete(theirs.headers["Location"])


def test_expired_is_told_from_unknown(ann: httpx.Client, bob: httpx.Client, server: Server) -> None:
    key = {"Idempotency-Key": "short"}
    answer = create(ann, params={"lifetime": 1}, headers=key)
    path = answer.headers["Location"]
    time.sleep(1.1)
    for late in [*uses(ann, path), ann.delete(path)]:
        assert code_of(late) == (410, "avatar_expired")
    assert code_of(bob.get(path)) == (404, "avatar_not_found")
    assert path not in ann.get("/v1/avatars").text
    assert not list(server.store.glob(f"{answer.json()['id']}.avatar"))
    again = create(ann, params={"lifetime": 1}, headers=key)  # the key brings a new one
    assert again.status_code == 201
    assert again.json()["id"] != answer.json()["id"]


def test_avatars_of_other_weights_say_so(ann: httpx.Client, server: Server, path: str) -> None:
    damage(server, ann, path, ann.get(path).json()["fingerprint"].encode(), b"0" * 16)
    look, *pictures = uses(ann, path)
    assert look.status_code == 200
    for answer in pictures:
        assert code_of(answer) == (409, "model_changed")
        assert "again" in answer.json()["hint"]


def test_a_damaged_file_says_so(ann: httpx.Client, server: Server, path: str) -> None:
    damage(server, ann, path, b"cvthead-avatar", b"another-format")
    for answer in uses(ann, path):
        assert code_of(answer) == (410, "invalid_avatar_file")
        assert str(server.store) not in answer.text
    assert ann.delete(path).status_code == 204


def test_a_full_store_refuses(ann: httpx.Client, bob: httpx.Client) -> None:
    made = [create(client) for client in (ann, bob, ann, bob)]
    assert {answer.status_code for answer in made} == {201}
    assert code_of(create(ann)) == (507, "store_full")
    assert ann.delete(made[0].headers["Location"]).status_code == 204
    assert create(ann).status_code == 201
    for client in (ann, bob):
        for item in client.get("/v1/avatars").json()["items"]:
            client.delete(item["links"]["self"])


def test_avatars_and_retries_survive_a_restart(tmp_path: Path) -> None:
    key = {"Idempotency-Key": "before the restart"}
    with start_server(tmp_path, keys=KEYS) as first, first.client(ANN) as client:
        made = create(client, headers=key)
        path = made.headers["Location"]
        before = client.post(f"{path}/render")
    with start_server(tmp_path, keys=KEYS) as second, second.client(ANN) as client:
        assert client.get(path).json() == made.json()
        assert client.get(path).headers["ETag"] == made.headers["ETag"]
        after = client.post(f"{path}/render")
        assert after.status_code == 200
        assert len(after.content) == pytest.approx(len(before.content), rel=0.1)
        assert create(client, headers=key).json() == made.json()
        refused = client.post(
            "/v1/avatars?consent=true",
            content=saved(Image.new("RGB", (64, 64))),
            headers=key,
        )
        assert code_of(refused) == (422, "idempotency_mismatch")
        with second.client(BOB) as other:
            assert other.get(path).status_code == 404
