"""Stills with C2PA manifests, read back by the C2PA library."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from server_process import PORTRAIT, start_server

from cvthead.errors import InputError
from cvthead.images import encode_image
from cvthead.provenance import SourceType, read_mark
from service.settings import load_settings
from service.signing import StillSigner

c2pa = pytest.importorskip("c2pa", reason="needs the extra c2pa")

from made_certificates import SIGNER, Files, write_chain  # noqa: E402  (needs cryptography)

PNG = encode_image(np.full((64, 48, 3), 90, np.uint8))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    return write_chain(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def signing(
    tmp_path_factory: pytest.TempPathFactory, files: Files
) -> Iterator[tuple[httpx.Client, str]]:
    """A client of a service that signs, and the path of an avatar."""
    with (
        start_server(
            tmp_path_factory.mktemp("signing"),
            c2pa_certificates=files.certificates,
            c2pa_private_key=files.private_key,
        ) as server,
        server.client() as client,
    ):
        uploaded = client.post("/v1/avatars", content=PORTRAIT.read_bytes())
        yield client, uploaded.headers["Location"]


def manifest(data: bytes, media_type: str) -> dict[str, Any]:
    """The active manifest; its signature and the hash of the picture are right."""
    with c2pa.Reader(media_type, io.BytesIO(data)) as reader:
        assert reader.get_validation_state() == "Valid"
        found: dict[str, Any] = json.loads(reader.json())
    active: dict[str, Any] = found["manifests"][found["active_manifest"]]
    return active


def source_type(data: bytes, media_type: str) -> str:
    found = manifest(data, media_type)
    assert found["signature_info"]["common_name"] == SIGNER
    (actions,) = (a["data"]["actions"] for a in found["assertions"] if "actions" in a["label"])
    (action,) = actions
    assert action["action"] == "c2pa.created"
    return str(action["digitalSourceType"])


@pytest.mark.parametrize("media_type", ["image/png", "image/jpeg", "image/webp"])
@pytest.mark.parametrize(
    ("background", "source"), [("white", SourceType.GENERATED), ("source", SourceType.COMPOSITE)]
)
def test_stills_are_signed(
    signing: tuple[httpx.Client, str], media_type: str, background: str, source: SourceType
) -> None:
    client, avatar = signing
    body = {"output": {"background": background}}
    answer = client.post(f"{avatar}/render", json=body, headers={"Accept": media_type})
    assert source_type(answer.content, media_type) == source
    assert read_mark(answer.content) == source
    assert "sign;dur=" in answer.headers["Server-Timing"]


def test_frames_of_a_batch_are_signed(signing: tuple[httpx.Client, str]) -> None:
    client, avatar = signing
    body = {"frames": [{}, {"arkit": {"jawOpen": 0.5}}]}
    answer = client.post(f"{avatar}/batch", json=body, headers={"Accept": "application/zip"})
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        for name in archive.namelist():
            assert source_type(archive.read(name), "image/png") == SourceType.GENERATED


def test_a_changed_picture_is_noticed(files: Files) -> None:
    signer = StillSigner(files.certificates, files.private_key)
    data = bytearray(signer.sign(PNG, "image/png", SourceType.GENERATED))
    assert manifest(bytes(data), "image/png")
    data[-20] ^= 1  # in the pixels
    with c2pa.Reader("image/png", io.BytesIO(data)) as reader:
        assert reader.get_validation_state() == "Invalid"


def test_threads_share_a_signer(files: Files) -> None:
    signer = StillSigner(files.certificates, files.private_key)
    with ThreadPoolExecutor(8) as pool:
        signed = pool.map(lambda _: signer.sign(PNG, "image/png", SourceType.GENERATED), range(32))
        assert all(manifest(data, "image/png") for data in signed)


def test_what_cannot_sign_is_refused_at_once(files: Files, tmp_path: Path) -> None:
    other = write_chain(tmp_path / "other")
    empty = tmp_path / "empty.pem"
    empty.touch()
    for certificates, key, message in (
        (tmp_path / "absent.pem", files.private_key, "absent.pem"),
        (files.certificates, tmp_path, "cannot read"),
        (empty, files.private_key, "cannot sign"),
        (files.certificates, empty, "cannot sign"),
        (files.certificates, other.private_key, "cannot sign"),
    ):
        with pytest.raises(InputError, match=message):
            StillSigner(certificates, key)


def test_a_missing_extra_is_named(files: Files, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "c2pa", None)
    with pytest.raises(InputError, match="c2pa") as caught:
        StillSigner(files.certificates, files.private_key)
    assert "cvthead[c2pa]" in caught.value.hint


def test_the_service_does_not_start_without_its_key(files: Files, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "cvthead.cli.main", "serve", "--port", "0"]
    environment = {
        "CVTHEAD_C2PA_CERTIFICATES": str(files.certificates),
        "CVTHEAD_C2PA_PRIVATE_KEY": str(tmp_path / "absent.pem"),
        "CVTHEAD_STORE": str(tmp_path / "store"),
    }
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240)
    assert done.returncode == 2
    assert "absent.pem" in done.stderr
    assert "Traceback" not in done.stderr


def test_certificates_and_key_go_together(files: Files) -> None:
    with pytest.raises(InputError, match="go together"):
        load_settings(c2pa_certificates=files.certificates)
