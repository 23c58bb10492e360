"""Pictures from coefficients."""

from __future__ import annotations

import json
from typing import Any

import httpx
import numpy as np
import pytest
from made_pictures import difference, opened, pixels
from server_process import PORTRAIT

from cvthead.head.arkit import ARKIT_NAMES
from cvthead.provenance import SourceType, read_mark


@pytest.fixture(scope="module")
def path(avatar_id: str) -> str:
    return f"/v1/avatars/{avatar_id}"


@pytest.fixture(scope="module")
def source(client: httpx.Client, path: str) -> dict[str, Any]:
    found: dict[str, Any] = client.get(path).json()["source"]
    return found


def render(client: httpx.Client, path: str, body: Any = None, **headers: str) -> httpx.Response:
    return client.post(f"{path}/render", json=body, headers=headers)


def rendered(client: httpx.Client, path: str, body: Any = None) -> np.ndarray:
    answer = render(client, path, body)
    assert answer.status_code == 200, answer.text
    return pixels(answer.content)


def refused(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    assert answer.headers["Content-Type"] == "application/problem+json", answer.headers
    body: dict[str, Any] = answer.json()
    assert (answer.status_code, body["code"]) == (status, code), body
    return body


def test_nothing_asked_is_the_portrait(client: httpx.Client, path: str, source: Any) -> None:
    plain = rendered(client, path)
    assert plain.shape == (256, 256, 4)
    assert 0.2 < (plain[..., 3] > 128).mean() < 0.95
    bodies: list[Any] = [
        {},
        {"pose": {}, "camera": {}, "arkit": None},
        source,
        {"mode": "relative"},
    ]
    for same in bodies:
        assert difference(rendered(client, path, same), plain) < 1
    empty = client.post(f"{path}/render", headers={"Content-Type": "image/png"})
    assert np.array_equal(pixels(empty.content), plain)


@pytest.mark.parametrize(
    "body",
    [
        {"shape": [3.0] + [0.0] * 99},
        {"expression": [2.5] + [0.0] * 49},
        {"pose": {"global": [0, 0.4, 0]}},
        {"pose": {"neck": [0.3, 0, 0]}},
        {"pose": {"jaw": [0.35, 0, 0]}},
        {"pose": {"left_eye": [0, 0.5, 0], "right_eye": [0, 0.5, 0]}},
        {"camera": {"scale": 4.5}},
        {"camera": {"tx": 0.02}},
        {"arkit": {"jawOpen": 0.8}},
        {"mode": "relative", "pose": {"global": [0, 0, 0.3]}},
    ],
)
def test_every_control_changes_the_picture(body: Any, client: httpx.Client, path: str) -> None:
    assert difference(rendered(client, path, body), rendered(client, path)) > 0.2


def test_relative_adds_to_the_portrait(client: httpx.Client, path: str, source: Any) -> None:
    step = [0.5] + [0.0] * 49
    sum_of_both = np.add(source["expression"], step).tolist()
    relative = rendered(client, path, {"expression": step, "mode": "relative"})
    assert difference(relative, rendered(client, path, {"expression": sum_of_both})) < 1
    assert difference(relative, rendered(client, path, {"expression": step})) > 0.1


@pytest.mark.parametrize("kind", ["png", "jpeg", "webp"])
@pytest.mark.parametrize(
    ("background", "mark"),
    [
        (None, "GENERATED"),
        ("#ff8000", "GENERATED"),
        ("white", "GENERATED"),
        ("source", "COMPOSITE"),
    ],
)
def test_formats_backgrounds_and_marks(
    kind: str, background: str | None, mark: str, client: httpx.Client, path: str
) -> None:
    body = {"output": {} if background is None else {"background": background}}
    answer = render(client, path, body, Accept=f"image/{kind}")
    assert answer.status_code == 200, answer.text
    assert answer.headers["Content-Type"] == f"image/{kind}"
    assert "Accept" in answer.headers["Vary"]
    assert answer.headers["X-Digital-Source-Type"] == SourceType[mark]
    assert read_mark(answer.content) == SourceType[mark]
    image = opened(answer.content)
    assert (image.format or "").lower() == kind
    clear = background is None and kind != "jpeg"
    assert image.mode == ("RGBA" if clear else "RGB")
    corner = pixels(answer.content)[2, 2]
    if clear:
        assert corner[3] < 20
    elif background == "#ff8000":
        assert np.abs(corner[:3] - (255, 128, 0)).max() < 25
    elif background != "source":
        assert corner[:3].min() > 235


@pytest.mark.parametrize("size", [16, 100, 256, 700, 1024])
def test_sizes(size: int, client: httpx.Client, path: str) -> None:
    answer = render(client, path, {"output": {"size": size}})
    assert opened(answer.content).size == (size, size)


def test_quality_makes_files_smaller(client: httpx.Client, path: str) -> None:
    files = [
        len(render(client, path, {"output": {"quality": q}}, Accept="image/jpeg").content)
        for q in (10, 95)
    ]
    assert files[0] < files[1] / 2


def test_transparent_jpeg_is_refused(client: httpx.Client, path: str) -> None:
    body = {"output": {"background": "transparent"}}
    answer = refused(render(client, path, body, Accept="image/jpeg"), 422, "invalid_request")
    assert answer["errors"][0]["pointer"] == "/output/background"


@pytest.mark.parametrize("accept", ["text/html", "image/gif", "image/png;q=0"])
def test_formats_that_are_not_made(accept: str, client: httpx.Client, path: str) -> None:
    refused(render(client, path, {}, Accept=accept), 406, "not_acceptable")
    answer = client.post(f"{path}/drive", content=b"x", headers={"Accept": accept})
    refused(answer, 406, "not_acceptable")


def test_stages_are_timed(client: httpx.Client, path: str) -> None:
    def stages(answer: httpx.Response) -> dict[str, float]:
        parts = (part.split(";dur=") for part in answer.headers["Server-Timing"].split(", "))
        return {name: float(milliseconds) for name, milliseconds in parts}

    timings = stages(render(client, path))
    assert list(timings) == ["queue", "pose", "paint", "encode"]
    assert timings["paint"] > 1
    driven = client.post(f"{path}/drive", content=PORTRAIT.read_bytes())
    assert "track" in stages(driven)


ZEROS = [0.0] * 50


@pytest.mark.parametrize(
    ("text", "pointer"),
    [
        ('{"expression": [NaN' + ",0" * 49 + "]}", "/expression/0"),
        ('{"expression": [0,Infinity' + ",0" * 48 + "]}", "/expression/1"),
        ('{"expression": [1e999' + ",0" * 49 + "]}", "/expression/0"),
        (json.dumps({"expression": ZEROS[:49]}), "/expression"),
        (json.dumps({"expression": [*ZEROS, 0.0]}), "/expression"),
        (json.dumps({"expression": [*ZEROS[:49], 51]}), "/expression/49"),
        (json.dumps({"expression": [*ZEROS[:49], "0"]}), "/expression/49"),
        (json.dumps({"expression": [*ZEROS[:49], True]}), "/expression/49"),
        (json.dumps({"expression": 0}), "/expression"),
        (json.dumps({"shape": [*[0.0] * 99, -21]}), "/shape/99"),
        ('{"pose": {"jaw": [0, 0]}}', "/pose/jaw"),
        ('{"pose": {"jaw": [0, 0, 7]}}', "/pose/jaw/2"),
        ('{"pose": [0, 0, 0]}', "/pose"),
        ('{"pose": {"mouth": [0, 0, 0]}}', "/pose/mouth"),
        ('{"camera": {"scale": 0}}', "/camera/scale"),
        ('{"camera": {"scale": -1}}', "/camera/scale"),
        ('{"camera": {"scale": 1e-300}}', "/camera/scale"),
        ('{"camera": {"tx": NaN}}', "/camera/tx"),
        ('{"arkit": {"jawOpen": 1.5}}', "/arkit/jawOpen"),
        ('{"arkit": {"grin": 1}}', "/arkit/grin"),
        ('{"mode": "sideways"}', "/mode"),
        ('{"jaw": [0, 0, 0]}', "/jaw"),
        ('{"output": {"size": 15}}', "/output/size"),
        ('{"output": {"size": 1025}}', "/output/size"),
        ('{"output": {"size": 1e30}}', "/output/size"),
        ('{"output": {"background": "pink"}}', "/output/background"),
        ('{"output": {"quality": 0}}', "/output/quality"),
        ('{"output": {"format": "png"}}', "/output/format"),
        ("[]", ""),
        ("null", ""),
    ],
)
def test_the_wrong_field_is_named(text: str, pointer: str, client: httpx.Client, path: str) -> None:
    answer = client.post(
        f"{path}/render", content=text, headers={"Content-Type": "application/json"}
    )
    body = refused(answer, 422, "invalid_request")
    pointers = [error["pointer"] for error in body["errors"]]
    assert any(found.startswith(pointer) for found in pointers), pointers
    assert all(error["in"] == "body" for error in body["errors"])


@pytest.mark.parametrize(
    "data", [b"{", b"\xff\xfe", b"[" * 100_000, b'{"a": ' * 10_000, b'{"shape": [1e]}']
)
def test_what_is_not_json(data: bytes, client: httpx.Client, path: str) -> None:
    answer = client.post(
        f"{path}/render", content=data, headers={"Content-Type": "application/json"}
    )
    refused(answer, 400, "invalid_json")


def test_a_long_body_is_cut_off(client: httpx.Client, path: str) -> None:
    answer = render(client, path, {"expression": [0] * 100_000})
    refused(answer, 413, "body_too_large")


def test_coefficients_come_as_json(client: httpx.Client, path: str) -> None:
    for kind in ("text/plain", "image/png", "application/x-www-form-urlencoded"):
        answer = client.post(f"{path}/render", content=b"{}", headers={"Content-Type": kind})
        refused(answer, 415, "unsupported_media_type")


def test_a_sum_out_of_range_is_named(client: httpx.Client, path: str) -> None:
    body = {"expression": [50.0] * 50, "mode": "relative", "arkit": dict.fromkeys(ARKIT_NAMES, 1)}
    answer = refused(render(client, path, body), 422, "invalid_coefficients")
    assert "expression" in answer["detail"]


def test_extremes_are_rendered(client: httpx.Client, path: str) -> None:
    for body in (
        {"shape": [20.0] * 100},
        {"expression": [-50.0] * 50},
        {"camera": {"scale": 1000, "tx": 10, "ty": -10}},
        {"camera": {"scale": 0.01}},
        {"pose": {"global": [6.28, 6.28, 6.28]}},
        {"arkit": dict.fromkeys(ARKIT_NAMES, 1)},
    ):
        assert render(client, path, body).status_code == 200, body
