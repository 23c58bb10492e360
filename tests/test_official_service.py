"""The official preset behind the service: every endpoint, on a real server."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import made_official
import numpy as np
import pytest
from cvthead_client import Client, CVTHeadClientError
from cvthead_client.driver import LocalTracker
from cvthead_client.hello import Hello, StreamOutput
from made_avatars import made_avatar
from PIL import Image
from raw_stream import coefficients, jpeg, pixels, raw_stream
from server_process import PORTRAIT, Server, start_server

from cvthead.cache import AvatarCache
from cvthead.official.avatar import OfficialAvatar
from cvthead.official.manifest import LICENCES, Manifest
from cvthead.provenance import read_mark

WHITE = {"output": {"background": "white"}}
# What raw_stream.coefficients(jaw=0.3) says.
ZERO = {joint: [0.0] * 3 for joint in ("global", "neck", "left_eye", "right_eye")}
OPEN = {"expression": [0.0] * 50, "pose": ZERO | {"jaw": [0.3, 0.0, 0.0]}}


@pytest.fixture(scope="module")
def server(official_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Keeps one avatar in memory, so that another one has to be read from the store."""
    settings = {"preset": "official", "model": official_folder / "model", "memory_bytes": 0}
    with start_server(tmp_path_factory.mktemp("service"), **settings) as running:
        yield running


@pytest.fixture(scope="module")
def client(server: Server) -> Iterator[httpx.Client]:
    with server.client() as connected:
        yield connected


@pytest.fixture(scope="module")
def tilted() -> bytes:
    with Image.open(PORTRAIT) as image:
        return jpeg(image.convert("RGB").rotate(15, fillcolor="white"))


def test_from_upload_to_deletion(
    server: Server, client: httpx.Client, official_folder: Path, tilted: bytes
) -> None:
    fingerprint = Manifest.load(official_folder / "model").fingerprint
    answer = client.post("/v1/avatars", content=PORTRAIT.read_bytes())
    assert answer.status_code == 201, answer.text
    made = answer.json()
    path = made["links"]["self"]
    assert (made["preset"], made["fingerprint"]) == ("official", fingerprint)
    left, top, right, bottom = made["face_box"]
    assert left < right
    assert top < bottom
    stored = OfficialAvatar.load(server.store / f"{made['id']}.avatar")
    np.testing.assert_array_equal(
        np.float32(made["source"]["expression"]), stored.coefficients.expression
    )

    with Client(server.url) as own, pytest.raises(CVTHeadClientError, match="preset official"):
        LocalTracker(own.get(made["id"]), "absolute", follow=False)

    render = f"{path}/render"
    still = client.post(render, json=WHITE)
    assert still.status_code == 200, still.text
    assert read_mark(still.content)
    assert pixels(client.get(f"{path}/preview?background=white").content).shape == (256, 256, 3)
    opened = client.post(render, json=OPEN | WHITE)
    smile = client.post(render, json={"arkit": {"mouthSmileLeft": 1.0}} | WHITE)
    frames = [pixels(answer.content) for answer in (still, opened, smile)]
    assert len({frame.tobytes() for frame in frames}) == 3
    refused = client.post(render, json={"arkit": {"mouthSmile": 1.0}})
    assert (refused.status_code, refused.json()["code"]) == (422, "invalid_request")

    with zipfile.ZipFile(io.BytesIO(batch(client, path))) as files:
        pictures = [pixels(files.read(name)) for name in sorted(files.namelist())[:2]]
    assert np.array_equal(pictures[0], frames[0])
    assert np.array_equal(pictures[1], frames[1])

    driven = client.post(
        f"{path}/drive?background=white",
        files={"image": tilted, "reference": tilted},
    )
    assert driven.status_code == 200, driven.text
    assert np.array_equal(pixels(driven.content), frames[0]), "no motion since the reference"
    driven = client.post(f"{path}/drive?background=white&camera=driver", content=tilted)
    assert driven.status_code == 200, driven.text

    with raw_stream(server.host, made["id"]) as stream:
        assert stream.hello(Hello(StreamOutput("png", background="white")))["type"] == "hello"
        stream.numbers(1, coefficients(jaw=0.3))
        assert np.array_equal(pixels(stream.rendered().payload), frames[1])
        stream.acknowledge(1)
        stream.picture(2, tilted)
        assert not np.array_equal(pixels(stream.rendered().payload), frames[1])

    assert client.delete(path).status_code == 204
    assert client.post(render).status_code == 404
    assert not list(server.store.glob(f"{made['id']}*"))


def batch(client: httpx.Client, path: str) -> bytes:
    body = {"frames": [{}, OPEN]} | WHITE
    answer = client.post(f"{path}/batch", json=body, headers={"Accept": "application/zip"})
    assert answer.status_code == 200, answer.text
    return answer.content


def test_measuring_a_face(client: httpx.Client, tilted: bytes) -> None:
    """FLAME's coefficients by DECA, and the blendshape network's scores."""
    straight, turned = (
        client.post("/v1/track", content=data).json() for data in (PORTRAIT.read_bytes(), tilted)
    )
    assert len(straight["shape"]) == 100
    assert 0 <= straight["arkit"]["jawOpen"] <= 1
    assert straight["expression"] != turned["expression"]
    refused = client.post("/v1/track", content=jpeg(np.zeros((64, 64, 3), np.uint8)))
    assert (refused.status_code, refused.json()["code"]) == (422, "no_face")


def test_what_is_loaded(client: httpx.Client) -> None:
    assert client.get("/health/ready").status_code == 200
    (model,) = client.get("/v1/models").json()["items"]
    assert model["preset"] == "official"
    assert model["licences"]["imported"] == {entry.part: entry.licence for entry in LICENCES}
    assert "non-commercial" in model["licences"]["head"]
    assert 'preset="official"' in client.get("/metrics").text


def test_an_avatar_of_the_open_preset_is_a_conflict(server: Server, client: httpx.Client) -> None:
    """It can be looked at and deleted; pictures are refused, whichever way they are asked for."""
    record = AvatarCache(server.store).put(made_avatar())
    path = f"/v1/avatars/{record.id}"
    assert client.get(path).json()["preset"] == "open"
    answers = [
        client.post(f"{path}/render"),
        client.get(f"{path}/preview?background=source"),
        client.post(f"{path}/drive", content=PORTRAIT.read_bytes()),
        client.post(f"{path}/batch", json={"frames": [{}]}),
    ]
    for answer in answers:
        assert (answer.status_code, answer.json()["code"]) == (409, "model_changed"), answer.text
    with raw_stream(server.host, record.id) as stream:
        assert stream.ending() == (4409, "model_changed")
    assert client.delete(path).status_code == 204


def test_two_avatars_of_different_presets_in_one_store(tmp_path: Path) -> None:
    """The cache reads each as what it is."""
    official = made_official.avatar()
    cache = AvatarCache(tmp_path)
    keys = [cache.put(avatar).id for avatar in (official, made_avatar())]
    again = AvatarCache(tmp_path)
    found, other = (again.get(key) for key in keys)
    assert isinstance(found, OfficialAvatar)
    assert np.array_equal(found.descriptors, official.descriptors)
    assert (found.camera, found.crop, found.square) == (
        official.camera,
        official.crop,
        official.square,
    )
    assert (other.preset, again.record(keys[0]).preset) == ("open", "official")
