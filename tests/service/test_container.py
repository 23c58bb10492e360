"""Dockerfile and compose.yaml keep what docs/service.md promises of them."""

from __future__ import annotations

import re

from server_process import ROOT

DOCKERFILE = (ROOT / "Dockerfile").read_text()
COMPOSE = (ROOT / "compose.yaml").read_text()


def last(instruction: str) -> str:
    """What the final stage says."""
    stage = re.split(r"^FROM ", DOCKERFILE, flags=re.MULTILINE)[-1].replace("\\\n", " ")
    found: list[str] = re.findall(rf"^{instruction}\s+(.*)$", stage, re.MULTILINE)
    assert found, f"no {instruction}"
    return found[-1]


def test_the_service_is_not_root() -> None:
    assert last("USER").split(":")[0] not in ("root", "0")


def test_the_image_checks_that_the_service_is_ready() -> None:
    assert "/health/ready" in last("HEALTHCHECK")


def test_avatars_outlive_the_container() -> None:
    store = re.search(r"CVTHEAD_STORE=(\S+)", DOCKERFILE)
    assert store
    assert last("VOLUME") == store[1]
    mounted = re.search(rf"^ +- (\w+):{re.escape(store[1])}$", COMPOSE, re.MULTILINE)
    assert mounted
    volumes = COMPOSE.split("\nvolumes:\n")[1]
    assert re.search(rf"^  {mounted[1]}:", volumes, re.MULTILINE)
