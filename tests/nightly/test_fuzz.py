"""2,000 mutated images against a real server: only 2xx and 4xx, and no growth."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import httpx
import numpy as np
import pytest
from memory import GROWTH, resident
from mutations import mutated, seeds
from PIL import Image
from server_process import PORTRAIT, start_server

IMAGES = 2000
WARM_UP = 0.2
SEED = 20_260

pytestmark = pytest.mark.nightly


def test_mutated_images_are_refused_or_used(tmp_path: Path, part: float) -> None:
    random = np.random.default_rng(SEED)
    files = seeds(Image.open(PORTRAIT))
    count = round(IMAGES * part)
    seen: Counter[int] = Counter()
    failed: list[Path] = []
    # No avatar stays in memory: what is measured is what the decoders leave behind.
    with start_server(tmp_path, memory_bytes=0) as server, server.client() as client:
        driven = _upload(client, files[0]).json()["id"]
        paths = ("/v1/avatars", "/v1/track", f"/v1/avatars/{driven}/drive")
        # Every path and every size once, so that nothing is loaded for the first time later.
        for data in files:
            for path in paths:
                _send(client, path, data)
        warm = 0.0
        for number in range(count):
            data = mutated(files[number % len(files)], random)
            status = _send(client, paths[number % len(paths)], data)
            seen[status] += 1
            if not 200 <= status < 500:
                failed.append(tmp_path / f"{number}-{status}.bin")
                failed[-1].write_bytes(data)
            if number == round(count * WARM_UP):
                warm = resident(client)
        grown = resident(client) / warm - 1
        assert server.process.poll() is None
    print(dict(seen), f"resident set {grown:+.1%}")
    assert not failed
    assert {status // 100 for status in seen} == {2, 4}
    assert grown <= GROWTH


def _upload(client: httpx.Client, data: bytes) -> httpx.Response:
    headers = {"Content-Type": "application/octet-stream"}
    return client.post("/v1/avatars?consent=true", content=data, headers=headers)


def _send(client: httpx.Client, path: str, data: bytes) -> int:
    answer = client.post(path, content=data, headers={"Content-Type": "application/octet-stream"})
    if answer.status_code == 201:
        client.delete(answer.headers["Location"])
    elif answer.status_code >= 400:
        assert answer.headers["Content-Type"].startswith("application/problem+json")
    return answer.status_code
