"""20,000 renders: every one succeeds, and the server's memory does not grow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from memory import GROWTH, resident
from server_process import PORTRAIT, start_server

RENDERS = 20_000
WARM_UP = 0.05
FORMATS = ("image/png", "image/jpeg", "image/webp")

pytestmark = pytest.mark.nightly


def test_memory_is_flat_over_many_renders(tmp_path: Path, part: float) -> None:
    random = np.random.default_rng(0)
    count = round(RENDERS * part)
    with start_server(tmp_path) as server, server.client() as client:
        uploaded = client.post(
            "/v1/avatars?consent=true",
            content=PORTRAIT.read_bytes(),
            headers={"Content-Type": "image/png"},
        )
        address = f"{uploaded.headers['Location']}/render"
        warm = 0.0
        for number in range(count):
            request = {
                "mode": "relative",
                "pose": {"global": [0, float(random.uniform(-0.5, 0.5)), 0]},
                "arkit": {"jawOpen": float(random.random())},
            }
            accept = FORMATS[number % len(FORMATS)]
            answer = client.post(address, json=request, headers={"Accept": accept})
            assert answer.status_code == 200, answer.text
            if number == round(count * WARM_UP):
                warm = resident(client)
        grown = resident(client) / warm - 1
    print(f"resident set {grown:+.1%} after {count} renders")
    assert grown <= GROWTH
