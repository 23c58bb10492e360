"""Upload, look at, list and delete avatars."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from made_pictures import opened, pixels, portrait, saved, two_people
from server_process import PORTRAIT, Server

from cvthead.avatar import Avatar
from cvthead.provenance import read_mark


def create(client: httpx.Client, data: bytes, **more: Any) -> httpx.Response:
    return client.post("/v1/avatars", content=data, **more)


def code_of(answer: httpx.Response) -> tuple[int, str]:
    return answer.status_code, answer.json().get("code", "")


def test_an_upload_is_described(client: httpx.Client, server: Server) -> None:
    files = {"image": ("me.png", PORTRAIT.read_bytes(), "image/png")}
    answer = client.post("/v1/avatars", files=files, data={"lifetime": "3600", "consent": "true"})
    assert answer.status_code == 201, answer.text
    info = answer.json()
    path = f"/v1/avatars/{info['id']}"
    assert answer.headers["Location"] == path == info["links"]["self"]
    assert info["links"]["render"] == f"{path}/render"
    created, expires = (datetime.fromisoformat(info[name]) for name in ("created", "expires"))
    assert abs(datetime.now(UTC) - created) < timedelta(seconds=60)
    assert expires - created == timedelta(seconds=3600)
    file = server.store / f"{info['id']}.avatar"
    assert info["bytes"] == file.stat().st_size < 1_000_000
    assert info["preset"] == "open"
    left, top, right, bottom = info["face_box"]
    assert 150 < left < right < 300
    assert 50 < top < bottom < 200
    avatar = Avatar.load(file)
    source = info["source"]
    assert np.array_equal(np.float32(source["shape"]), avatar.coefficients.shape)
    assert np.array_equal(np.float32(source["expression"]), avatar.coefficients.expression)
    pose = [
        v
        for name in ("global", "neck", "jaw", "left_eye", "right_eye")
        for v in source["pose"][name]
    ]
    assert np.array_equal(np.array(pose, np.float32), avatar.coefficients.pose)
    assert source["camera"]["scale"] == avatar.camera.scale
    assert info["fingerprint"] == avatar.fingerprint
    assert client.delete(path).status_code == 204


def test_a_known_avatar_is_not_sent_again(client: httpx.Client, avatar_id: str) -> None:
    path = f"/v1/avatars/{avatar_id}"
    first = client.get(path)
    etag = first.headers["ETag"]
    assert first.status_code == 200
    assert first.json()["id"] == avatar_id
    for sent in (etag, f"W/{etag}", f'"x", {etag}', "*"):
        answer = client.get(path, headers={"If-None-Match": sent})
        assert (answer.status_code, answer.content) == (304, b"")
        assert answer.headers["ETag"] == etag
    assert client.get(path, headers={"If-None-Match": '"x"'}).content == first.content


def test_one_face_unless_one_is_chosen(client: httpx.Client) -> None:
    refused = create(client, two_people())
    assert code_of(refused) == (422, "several_faces")
    boxes = refused.json()["boxes"]
    assert len(boxes) == 2
    for face in range(2):
        answer = create(client, two_people(), params={"face": face})
        assert answer.status_code == 201, answer.text
        assert np.abs(np.subtract(answer.json()["face_box"], boxes[face])).max() < 10
        client.delete(answer.headers["Location"])
    assert code_of(create(client, two_people(), params={"face": 2})) == (422, "no_face")


@pytest.mark.parametrize(
    ("query", "pointer"),
    [
        ({"face": "-1"}, "/face"),
        ({"face": "first"}, "/face"),
        ({"lifetime": "0"}, "/lifetime"),
        ({"lifetime": "nan"}, "/lifetime"),
        ({"lifetime": "1e9"}, "/lifetime"),
        ({"consent": "perhaps"}, "/consent"),
        ({"fase": "0"}, "/fase"),
    ],
)
def test_options_out_of_range(query: dict[str, str], pointer: str, client: httpx.Client) -> None:
    answer = create(client, PORTRAIT.read_bytes(), params=query)
    assert code_of(answer) == (422, "invalid_request")
    assert answer.json()["errors"][0]["pointer"] == pointer


def test_deleted_is_gone_from_every_tier(client: httpx.Client, server: Server) -> None:
    path = create(client, PORTRAIT.read_bytes()).headers["Location"]
    assert client.get(f"{path}/preview").status_code == 200  # now in memory
    answer = client.delete(path)
    assert (answer.status_code, answer.content) == (204, b"")
    for again in (
        client.get(path),
        client.get(f"{path}/preview"),
        client.delete(path),
        client.post(f"{path}/render"),
    ):
        assert code_of(again) == (404, "avatar_not_found")
    assert not list(server.store.glob(f"{path.rpartition('/')[2]}*"))


@pytest.mark.parametrize("wrong", ["0" * 32, "x", "A" * 32, "%2e%2e%2fpasswd", "%00", "é"])
@pytest.mark.parametrize("end", ["", "/preview", "/render", "/drive", "/batch"])
def test_unknown_ids(wrong: str, end: str, client: httpx.Client) -> None:
    body = b'{"frames": [{}]}'
    method = "GET" if end in ("", "/preview") else "POST"
    content = PORTRAIT.read_bytes() if end == "/drive" else body if end == "/batch" else None
    headers = {"Content-Type": "application/json"}
    path = f"/v1/avatars/{wrong}{end}"
    answer = client.request(method, path, content=content, headers=headers)
    assert answer.status_code == 404, answer.text
    assert answer.json()["code"] in ("avatar_not_found", "not_found")


def test_pages_are_newest_first_and_complete(client: httpx.Client) -> None:
    made = [create(client, PORTRAIT.read_bytes()).json()["id"] for _ in range(3)]
    found: list[dict[str, Any]] = []
    cursor: str | None = None
    while True:
        query = {"limit": "2"} | ({"cursor": cursor} if cursor else {})
        page = client.get("/v1/avatars", params=query).json()
        assert len(page["items"]) <= 2
        found += page["items"]
        cursor = page["next"]
        if cursor is None:
            break
        if len(found) == 2:  # the place where the next page begins
            client.delete(f"/v1/avatars/{found[-1]['id']}")
    ids = [item["id"] for item in found]
    assert [i for i in ids if i in made] == made[::-1]
    assert len(set(ids)) == len(ids)
    assert [item["created"] for item in found] == sorted(
        (item["created"] for item in found), reverse=True
    )
    assert "source" not in found[0]
    for identifier in made:
        client.delete(f"/v1/avatars/{identifier}")


@pytest.mark.parametrize(
    ("query", "pointer"),
    [({"limit": 0}, "/limit"), ({"limit": 1000}, "/limit"), ({"cursor": "abc"}, "/cursor")],
)
def test_pages_that_do_not_exist(query: Any, pointer: str, client: httpx.Client) -> None:
    answer = client.get("/v1/avatars", params=query)
    assert code_of(answer) == (422, "invalid_request")
    assert answer.json()["errors"][0]["pointer"] == pointer


def test_preview_is_the_portrait_and_marked(client: httpx.Client, avatar_id: str) -> None:
    path = f"/v1/avatars/{avatar_id}"
    answer = client.get(f"{path}/preview", params={"size": 128, "background": "source"})
    assert answer.status_code == 200
    assert opened(answer.content).size == (128, 128)
    assert read_mark(answer.content) == answer.headers["X-Digital-Source-Type"]
    same = client.post(f"{path}/render", json={"output": {"size": 128, "background": "source"}})
    assert np.abs(pixels(same.content) - pixels(answer.content)).max() == 0
    refused = client.get(f"{path}/preview", params={"size": 4000})
    assert code_of(refused) == (422, "invalid_request")
    refused = client.get(f"{path}/preview", headers={"Accept": "text/html"})
    assert code_of(refused) == (406, "not_acceptable")


def test_a_retry_makes_no_second_avatar(client: httpx.Client) -> None:
    key = {"Idempotency-Key": "retry-1"}
    first, second = (create(client, PORTRAIT.read_bytes(), headers=key) for _ in range(2))
    assert (first.status_code, second.status_code) == (201, 201)
    assert first.content == second.content
    assert "Idempotency-Replayed" not in first.headers
    assert second.headers["Idempotency-Replayed"] == "true"
    for other in (
        create(client, saved(portrait(400)), headers=key),
        create(client, PORTRAIT.read_bytes(), headers=key, params={"face": 0}),
    ):
        assert code_of(other) == (422, "idempotency_mismatch")
    client.delete(first.headers["Location"])
    again = create(client, PORTRAIT.read_bytes(), headers=key)
    assert again.status_code == 201
    assert again.json()["id"] != first.json()["id"]  # the deleted one does not come back
    client.delete(again.headers["Location"])


def test_a_failed_upload_can_be_mended_under_the_same_key(client: httpx.Client) -> None:
    key = {"Idempotency-Key": "retry-2"}
    assert create(client, b"nothing", headers=key).status_code == 415
    answer = create(client, PORTRAIT.read_bytes(), headers=key)
    assert answer.status_code == 201
    client.delete(answer.headers["Location"])


def test_the_same_key_at_once_makes_one_avatar(client: httpx.Client, server: Server) -> None:
    before = set(server.store.glob("*.avatar"))

    async def race() -> list[httpx.Response]:
        async with httpx.AsyncClient(base_url=server.url, timeout=120) as several:
            headers = {"Idempotency-Key": "race"}
            post = [
                several.post("/v1/avatars", content=PORTRAIT.read_bytes(), headers=headers)
                for _ in range(6)
            ]
            return list(await asyncio.gather(*post))

    answers = asyncio.run(race())
    made = [answer for answer in answers if answer.status_code == 201]
    assert len({answer.json()["id"] for answer in made}) == 1
    for answer in answers:
        if answer.status_code != 201:
            assert code_of(answer) == (409, "idempotency_conflict")
            assert int(answer.headers["Retry-After"]) >= 1
    new = set(server.store.glob("*.avatar")) - before
    assert [path.stem for path in new] == [made[0].json()["id"]]
    client.delete(made[0].headers["Location"])


def test_what_is_stored_is_for_the_user_alone(server: Server, avatar_id: str) -> None:
    files: list[Path] = list(server.store.glob(f"{avatar_id}.*"))
    assert {path.suffix for path in files} == {".avatar", ".json"}
    assert {path.stat().st_mode & 0o777 for path in files} == {0o600}
