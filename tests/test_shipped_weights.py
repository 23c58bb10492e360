"""What is written down about the weights that ship is about these."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cvthead.runtime.model_folder import packaged

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def record() -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((packaged("open") / "model.json").read_text())
    return loaded


def test_the_model_card_names_them(record: dict[str, Any]) -> None:
    card = (ROOT / "docs/model_card.md").read_text()
    assert f"`{record['fingerprint']}`" in card
    assert record["training"]["date"] in card
    assert record["training"]["records_sha256"] in card


def test_they_were_made_with_the_shipped_configuration(record: dict[str, Any]) -> None:
    pytest.importorskip("torch")
    from cvthead.training.config import load_config

    config = load_config("open-fine", {}).model_dump(mode="json")
    settings = json.loads(record["training"]["settings"])
    assert {name: config[name] for name in settings} == settings
    assert "losses" in settings


def test_the_training_page_names_every_shipped_configuration() -> None:
    page = (ROOT / "docs/training.md").read_text()
    names = [path.stem for path in (ROOT / "cvthead/training/configs").glob("*.toml")]
    assert len(names) > 3
    assert [name for name in names if f"cvthead train {name}" not in page] == []
