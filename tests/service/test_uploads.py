"""Pictures of every kind, whole and broken; through /v1/track, which decodes as all paths do."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from made_pictures import GUISES, jpeg_header, png_header, portrait, saved, two_people, webp_header
from PIL import Image
from server_process import PORTRAIT, Server

Files = dict[str, Any]


def track(client: httpx.Client, data: bytes, **query: Any) -> httpx.Response:
    return client.post("/v1/track", content=data, params=query)


def problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    assert answer.headers["Content-Type"] == "application/problem+json", answer.text
    body: dict[str, Any] = answer.json()
    assert (answer.status_code, body["code"]) == (status, code), body
    return body


@pytest.fixture(scope="module")
def expected(client: httpx.Client) -> dict[str, Any]:
    answer = track(client, PORTRAIT.read_bytes())
    assert answer.status_code == 200
    body: dict[str, Any] = answer.json()
    return body


def test_track_measures_the_face(expected: dict[str, Any]) -> None:
    assert (len(expected["shape"]), len(expected["expression"])) == (100, 50)
    assert set(expected["pose"]) == {"global", "neck", "jaw", "left_eye", "right_eye"}
    assert all(len(rotation) == 3 for rotation in expected["pose"].values())
    left, top, right, bottom = expected["box"]
    assert 150 < left < right < 300
    assert 50 < top < bottom < 200
    assert expected["camera"]["scale"] > 0
    assert expected["presence"] > 0.9
    assert expected["error"] < 5
    assert abs(expected["yaw"]) < 20
    assert len(expected["arkit"]) == 51
    assert expected["arkit"]["mouthSmileLeft"] > 0.5 > expected["arkit"]["jawOpen"]


@pytest.mark.parametrize("guise", GUISES)
def test_the_same_face_in_every_guise(
    guise: str, client: httpx.Client, expected: dict[str, Any]
) -> None:
    answer = track(client, GUISES[guise](), blendshapes=False)
    assert answer.status_code == 200, answer.text
    assert answer.json()["arkit"] is None
    assert np.abs(np.subtract(answer.json()["box"], expected["box"])).max() < 4


def test_multipart_is_as_good_as_raw(client: httpx.Client, expected: dict[str, Any]) -> None:
    files: Files = {"image": ("a.exe", PORTRAIT.read_bytes(), "text/plain")}  # not believed
    answer = client.post("/v1/track", files=files, data={"blendshapes": "true"})
    assert answer.json() == expected


def test_faces_are_chosen_by_size(client: httpx.Client) -> None:
    boxes = [track(client, two_people(), face=i).json()["box"] for i in range(2)]
    assert boxes[0][0] < 270 < boxes[1][0]
    assert track(client, two_people()).json()["box"] == boxes[0]
    body = problem(track(client, two_people(), face=2), 422, "no_face")
    assert "2" in body["detail"]


@pytest.mark.parametrize(
    ("data", "status", "code"),
    [
        (b"", 415, "unsupported_media_type"),
        (b"hello", 415, "unsupported_media_type"),
        (b"GIF89a" + bytes(100), 415, "unsupported_media_type"),
        (b"%PDF-1.7", 415, "unsupported_media_type"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", 415, "unsupported_media_type"),
        (PORTRAIT.read_bytes()[:20_000], 422, "invalid_image"),
        (saved(Image.new("RGB", (8, 8))), 422, "invalid_image"),
        (saved(Image.new("RGB", (256, 256), "green")), 422, "no_face"),
        (saved(portrait(200)), 422, "face_too_small"),
        # The detector finds a face upside down, the landmark network does not.
        (saved(portrait().rotate(180)), 422, "face_turned_away"),
        (bytes(21_000_000), 413, "body_too_large"),
    ],
)
def test_pictures_that_cannot_be_used(
    data: bytes, status: int, code: str, client: httpx.Client
) -> None:
    problem(track(client, data), status, code)


def test_a_body_that_hides_its_size_is_cut_off(client: httpx.Client) -> None:
    chunks = (bytes(1_000_000) for _ in range(40))  # no Content-Length
    problem(client.post("/v1/track", content=chunks), 413, "body_too_large")


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="reads the memory use from /proc")
@pytest.mark.parametrize("make", [png_header, jpeg_header, webp_header])
def test_bombs_are_refused_unopened(make: Any, client: httpx.Client, server: Server) -> None:
    bomb = make(16_000, 16_000) if make is webp_header else make(30_000, 30_000)
    assert len(bomb) < 50_000
    track(client, PORTRAIT.read_bytes())
    before = peak_kilobytes(server)
    body = problem(track(client, bomb), 413, "image_too_large")
    assert "000 x" in body["detail"]
    assert peak_kilobytes(server) - before < 50_000  # the smallest would take 750,000


def peak_kilobytes(server: Server) -> int:
    status = Path(f"/proc/{server.process.pid}/status").read_text()
    found = re.search(r"VmHWM:\s+(\d+)", status)
    assert found
    return int(found[1])


PICTURE = ("a.png", PORTRAIT.read_bytes())


@pytest.mark.parametrize(
    ("sent", "status", "code", "pointer"),
    [
        ({"files": {"picture": PICTURE}}, 422, "invalid_request", "/image"),
        ({"files": {"image": (None, "text")}}, 422, "invalid_request", "/image"),
        (
            {"files": [("image", PICTURE), ("image", PICTURE)]},
            400,
            "malformed_body",
            None,
        ),
        ({"files": {"image": PICTURE}, "data": {"face": "x"}}, 422, "invalid_request", "/face"),
        ({"files": {"image": PICTURE}, "data": {"fase": "1"}}, 422, "invalid_request", "/fase"),
        (
            {"files": {"image": PICTURE}, "data": {"face": ["0", "1"]}},
            422,
            "invalid_request",
            "/face",
        ),
        ({"files": {"image": PICTURE}, "data": {"face": "9" * 5000}}, 400, "malformed_body", None),
        ({"content": PICTURE[1], "params": {"face": -1}}, 422, "invalid_request", "/face"),
        ({"content": PICTURE[1], "params": {"fase": 1}}, 422, "invalid_request", "/fase"),
        (
            {"content": b"x", "headers": {"Content-Type": "multipart/form-data"}},
            400,
            "malformed_body",
            None,
        ),
        (
            {"content": b"x", "headers": {"Content-Type": "multipart/form-data; boundary=b"}},
            400,
            "malformed_body",
            None,
        ),
    ],
)
def test_malformed_uploads(
    sent: dict[str, Any], status: int, code: str, pointer: str | None, client: httpx.Client
) -> None:
    body = problem(client.post("/v1/track", **sent), status, code)
    if pointer is not None:
        assert pointer in [error["pointer"] for error in body["errors"]]


def test_uploads_leave_nothing_behind(client: httpx.Client, server: Server) -> None:
    before = sorted(server.store.rglob("*"))
    track(client, PORTRAIT.read_bytes())
    client.post("/v1/track", files={"image": PICTURE})
    assert sorted(server.store.rglob("*")) == before
