"""Accept headers as browsers and tools send them."""

from __future__ import annotations

import pytest

from service.negotiation import IMAGE_TYPES, best_type
from service.problems import Problem

CHROME = "image/avif,image/webp,image/apng,image/svg+xml,image/*,*/*;q=0.8"


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        (None, "image/png"),
        ("", "image/png"),
        ("*/*", "image/png"),
        ("image/*", "image/png"),
        (CHROME, "image/png"),
        ("image/webp", "image/webp"),
        ("IMAGE/JPEG", "image/jpeg"),
        ("image/webp, image/jpeg", "image/jpeg"),  # equally liked: the service's order
        ("image/webp;q=1.0, image/jpeg;q=0.9", "image/webp"),
        ("image/png;q=0.1, image/*", "image/jpeg"),
        ("image/png;q=0, */*", "image/jpeg"),
        ("text/html, image/webp ; q=0.2", "image/webp"),
        ("image/jpeg;charset=x;q=0.5, image/png;q=0.4", "image/jpeg"),
        (",,image/webp,", "image/webp"),
    ],
)
def test_best_type(accept: str | None, expected: str) -> None:
    assert best_type(accept, IMAGE_TYPES) == expected


@pytest.mark.parametrize(
    "accept",
    [
        "text/html",
        "image/gif",
        "image/png;q=0",
        "*/*;q=0",
        "image/webp;q=nan",
        "image/webp;q=",
        "x",
    ],
)
def test_nothing_acceptable(accept: str) -> None:
    with pytest.raises(Problem) as caught:
        best_type(accept, IMAGE_TYPES)
    assert caught.value.code == "not_acceptable"
    assert "image/webp" in caught.value.hint
