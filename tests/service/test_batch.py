"""Many frames in one answer."""

from __future__ import annotations

import email.policy
import time
import zipfile
from email.parser import BytesParser
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from made_pictures import opened, pixels
from server_process import Server

from cvthead.provenance import SourceType, read_mark
from cvthead.video import probe_video, read_frames
from service.frames import AHEAD

FRAMES = [{"arkit": {"jawOpen": value}} for value in (0.0, 0.4, 0.9)]


@pytest.fixture(scope="module")
def path(avatar_id: str) -> str:
    return f"/v1/avatars/{avatar_id}"


def batch(client: httpx.Client, path: str, kind: str, **body: Any) -> httpx.Response:
    body.setdefault("frames", FRAMES)
    return client.post(f"{path}/batch", json=body, headers={"Accept": kind})


def test_multipart_has_a_part_for_each_frame(client: httpx.Client, path: str) -> None:
    answer = batch(client, path, "*/*", output={"format": "webp", "size": 64})
    assert answer.status_code == 200
    assert answer.headers["Content-Type"].startswith("multipart/mixed; boundary=")
    assert answer.headers["X-Digital-Source-Type"] == SourceType.GENERATED
    head = f"Content-Type: {answer.headers['Content-Type']}\r\n\r\n".encode()
    message = BytesParser(policy=email.policy.HTTP).parsebytes(head + answer.content)
    assert not message.defects
    parts = list(message.iter_parts())
    assert [part.get_content_type() for part in parts] == ["image/webp"] * 3
    assert [part.get_filename() for part in parts] == [f"{i:06d}.webp" for i in range(3)]
    for part in parts:
        data = part.get_payload(decode=True)
        assert isinstance(data, bytes)
        assert int(part["Content-Length"]) == len(data)
        assert opened(data).size == (64, 64)
        assert read_mark(data) == SourceType.GENERATED


def test_zip_has_the_frames_that_render_gives(client: httpx.Client, path: str) -> None:
    answer = batch(client, path, "application/zip", output={"background": "source"})
    assert answer.headers["Content-Type"] == "application/zip"
    assert answer.headers["X-Digital-Source-Type"] == SourceType.COMPOSITE
    with zipfile.ZipFile(BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == [f"{i:06d}.png" for i in range(3)]
        for name, controls in zip(archive.namelist(), FRAMES, strict=True):
            body = {**controls, "output": {"background": "source"}}
            single = client.post(f"{path}/render", json=body).content
            data = archive.read(name)
            assert np.abs(pixels(data) - pixels(single)).mean() < 0.5
            assert read_mark(data) == SourceType.COMPOSITE


def test_mp4_is_a_video(client: httpx.Client, path: str, tmp_path: Path) -> None:
    answer = batch(client, path, "video/mp4", fps=12.5, output={"size": 128})
    assert answer.headers["Content-Type"] == "video/mp4"
    file = tmp_path / "a.mp4"
    file.write_bytes(answer.content)
    assert probe_video(file).fps == pytest.approx(12.5)
    frames = [image for image, _ in read_frames(file)]
    assert [frame.shape for frame in frames] == [(128, 128, 3)] * 3
    assert frames[0][2, 2].min() > 235  # on white
    assert read_mark(answer.content) == SourceType.GENERATED


@pytest.mark.parametrize(
    ("body", "code", "where"),
    [
        ({"frames": []}, "invalid_request", "/frames"),
        ({"frames": [{}] * 1001}, "invalid_request", "/frames"),
        ({"frames": [{}, {"pose": {"jaw": [0]}}]}, "invalid_request", "/frames/1/pose/jaw"),
        ({"frames": [{"output": {}}]}, "invalid_request", "/frames/0/output"),
        ({"fps": 0}, "invalid_request", "/fps"),
        ({"output": {"format": "gif"}}, "invalid_request", "/output/format"),
        (
            {"output": {"format": "jpeg", "background": "transparent"}},
            "invalid_request",
            "/output/background",
        ),
        (
            {"frames": [{}, {"mode": "relative", "expression": [50] * 50}]},
            "invalid_coefficients",
            None,
        ),
    ],
)
def test_mistakes_are_found_before_the_first_frame(
    body: Any, code: str, where: str | None, client: httpx.Client, path: str
) -> None:
    answer = batch(client, path, "*/*", **body)
    problem = answer.json()
    assert (answer.status_code, problem["code"]) == (422, code), problem
    if where is not None:
        assert problem["errors"][0]["pointer"].startswith(where)


def test_refused_kinds(client: httpx.Client, path: str) -> None:
    assert batch(client, path, "image/gif").json()["code"] == "not_acceptable"
    transparent = batch(client, path, "video/mp4", output={"background": "transparent"})
    assert transparent.json()["code"] == "invalid_request"
    empty = client.post(f"{path}/batch")
    assert (empty.status_code, empty.json()["code"]) == (422, "invalid_request")


def test_a_client_that_leaves_stops_the_work(
    server: Server, client: httpx.Client, path: str
) -> None:
    frames = 1000
    before = painted(client)
    with server.client() as leaving:
        request: Any = {"frames": [{}] * frames}
        with leaving.stream("POST", f"{path}/batch", json=request) as answer:
            assert answer.status_code == 200
            first = next(answer.iter_bytes())
            when_it_came = painted(client)
    assert first.startswith(b"--")
    assert when_it_came - before < frames / 2, "the first part waited for the others"
    deadline = time.monotonic() + 60
    while metric(client, "cvthead_requests_in_flight") > 1:  # this one
        assert time.monotonic() < deadline, "the batch of a client that has gone goes on"
        time.sleep(0.05)
    settled = painted(client)
    assert 0 < settled - before < frames / 2, "painted for a client that has gone"
    renders = 10
    for _ in range(renders):  # each would wait behind frames of the batch
        assert client.post(f"{path}/render").status_code == 200
    assert painted(client) - settled <= renders + AHEAD


def painted(client: httpx.Client) -> float:
    """Frames so far."""
    return metric(client, "cvthead_batch_size_sum")


def metric(client: httpx.Client, name: str) -> float:
    return float(client.get("/metrics").text.partition(f"\n{name} ")[2].split()[0])
