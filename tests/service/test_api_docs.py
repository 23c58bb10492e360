"""docs/api.md names every endpoint, and its examples work as pasted."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import httpx
import pytest
from made_pictures import opened
from server_process import ROOT, Server

DOCUMENT = (ROOT / "docs" / "api.md").read_text()


@pytest.fixture(scope="module")
def openapi(client: httpx.Client) -> Any:
    return client.get("/openapi.json").json()


def test_every_endpoint_is_described(openapi: Any) -> None:
    text = re.sub(r"\s+", " ", DOCUMENT)
    missing = [
        f"{method.upper()} {path}"
        for path, methods in openapi["paths"].items()
        for method in methods
        if f"`{method.upper()} {path}`" not in text
    ]
    assert not missing


def test_every_described_endpoint_exists(openapi: Any) -> None:
    named = set(re.findall(r"`(GET|POST|DELETE)\s+(/[^`]*)`", DOCUMENT))
    known = {(m.upper(), path) for path, methods in openapi["paths"].items() for m in methods}
    assert named - known <= {("GET", "/")}


@pytest.mark.skipif(not shutil.which("curl"), reason="needs curl")
def test_the_examples_work_as_pasted(server: Server, tmp_path: Path) -> None:
    script = "\n".join(re.findall(r"```sh\n(.*?)```", DOCUMENT, re.DOTALL))
    script = script.replace("http://127.0.0.1:8000", server.url)
    script = script.replace("curl -s ", "curl -sS --fail-with-body ")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for name, size in (
        ("preview.png", 128),
        ("smile.png", 256),
        ("wink.webp", 512),
        ("driven.jpg", 256),
        ("relative.png", 256),
    ):
        assert opened((tmp_path / name).read_bytes()).size == (size, size)
    assert (tmp_path / "talk.mp4").read_bytes()[4:8] == b"ftyp"
    assert (tmp_path / "frames.zip").read_bytes()[:2] == b"PK"


def test_every_field_has_a_description_and_an_example(openapi: Any) -> None:
    """Parameters, request fields and answer fields, wherever they are in the document."""
    bare: list[str] = []

    def visit(node: Any, place: str) -> None:
        if isinstance(node, list):
            for index, entry in enumerate(node):
                visit(entry, f"{place}/{index}")
        if not isinstance(node, dict):
            return
        if "in" in node and "schema" in node:
            # Its examples can be its own or its schema's.
            bare.extend(f"{place} {lack}" for lack in _lacks(node["schema"] | node))
        for name, field in node.get("properties", {}).items():
            if isinstance(field, dict):
                bare.extend(f"{place}/{name} {lack}" for lack in _lacks(field))
        for key, value in node.items():
            if key not in ("example", "examples", "default", "enum"):
                visit(value, f"{place}/{key}")

    visit(openapi, "")
    assert not bare


def _lacks(field: dict[str, Any]) -> list[str]:
    """What a field does not say by itself, by the object that it is or refers to, or as a file.
    The values of an enumeration or of a boolean are its examples."""
    nested = [field, *field.get("anyOf", []), field.get("items", {})]
    keys = {key for part in nested for key in part}
    if keys & {"$ref", "properties"} or any(part.get("format") == "binary" for part in nested):
        return []
    shown = keys & {"examples", "example", "enum", "const"}
    shown |= {"boolean"} & {part.get("type") for part in nested}
    there = {"description": "description" in keys, "example": bool(shown)}
    return [name for name, given in there.items() if not given]
