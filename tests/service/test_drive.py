"""Pictures from driving frames."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np
import pytest
from made_pictures import difference, head, opened, pixels, portrait, saved, two_people
from PIL import Image
from server_process import PORTRAIT

from cvthead.provenance import SourceType, read_mark


@pytest.fixture(scope="module")
def path(avatar_id: str) -> str:
    return f"/v1/avatars/{avatar_id}"


@pytest.fixture(scope="module")
def plain(client: httpx.Client, path: str) -> np.ndarray:
    """The portrait itself."""
    return pixels(client.post(f"{path}/render").content)


def drive(client: httpx.Client, path: str, data: bytes, **query: Any) -> httpx.Response:
    return client.post(f"{path}/drive", content=data, params=query)


def refused(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    assert answer.headers["Content-Type"] == "application/problem+json", answer.headers
    body: dict[str, Any] = answer.json()
    assert (answer.status_code, body["code"]) == (status, code), body
    return body


def test_driven_by_oneself_is_the_portrait(
    client: httpx.Client, path: str, plain: np.ndarray
) -> None:
    answer = drive(client, path, PORTRAIT.read_bytes())
    assert answer.status_code == 200, answer.text
    assert difference(pixels(answer.content), plain) < 6
    follows = drive(client, path, PORTRAIT.read_bytes(), camera="driver")
    assert difference(pixels(follows.content), plain) < 12


def test_the_driver_moves_the_head(client: httpx.Client, path: str, plain: np.ndarray) -> None:
    tilted = saved(portrait().rotate(15, fillcolor="white"))
    moved = pixels(drive(client, path, tilted).content)
    assert difference(moved, plain) > 8


def test_a_reference_makes_the_motion_relative(
    client: httpx.Client, path: str, plain: np.ndarray
) -> None:
    upright, tilted = saved(head()), saved(head().rotate(15, fillcolor="white"))

    def with_reference(data: bytes, reference: bytes, **fields: str) -> np.ndarray:
        files = {"image": ("a.png", data), "reference": ("b.png", reference)}
        answer = client.post(f"{path}/drive", files=files, data=fields)
        assert answer.status_code == 200, answer.text
        return pixels(answer.content)

    assert difference(with_reference(tilted, tilted), plain) < 6  # no motion at all
    assert difference(with_reference(tilted, upright), plain) > 8
    absolute = with_reference(tilted, tilted, relative="false", camera="source")
    assert difference(absolute, plain) > 8
    followed = with_reference(tilted, tilted, camera="driver", size="256")
    assert difference(followed, plain) < 6


def test_the_number_of_pixels_does_not_matter(
    client: httpx.Client, path: str, plain: np.ndarray
) -> None:
    """The same picture twice, once with twice the pixels a side: the head has neither moved nor
    grown."""
    small, large = (saved(portrait(side), "JPEG", quality=95) for side in (1000, 2000))
    files = {"image": ("a.jpg", large), "reference": ("b.jpg", small)}
    answer = client.post(f"{path}/drive", files=files, data={"camera": "driver"})
    assert answer.status_code == 200, answer.text
    assert difference(pixels(answer.content), plain) < 6


def test_drive_refuses(client: httpx.Client, path: str) -> None:
    refused(drive(client, path, PORTRAIT.read_bytes(), relative=True), 422, "invalid_request")
    refused(drive(client, path, PORTRAIT.read_bytes(), camera="mine"), 422, "invalid_request")
    refused(drive(client, path, b"text"), 415, "unsupported_media_type")
    refused(drive(client, path, saved(Image.new("RGB", (256, 256)))), 422, "no_face")
    assert drive(client, path, two_people()).status_code == 200  # the largest drives


def test_drive_options_make_the_picture(client: httpx.Client, path: str) -> None:
    answer = client.post(
        f"{path}/drive",
        files={"image": ("a.png", PORTRAIT.read_bytes())},
        data={"size": "64", "background": "source"},
        headers={"Accept": "image/webp"},
    )
    assert answer.headers["Content-Type"] == "image/webp"
    assert opened(answer.content).size == (64, 64)
    assert read_mark(answer.content) == SourceType.COMPOSITE
