"""The checkpoint that is best on other people is kept, and training is the same without it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning_fabric import Fabric
from made_records import make_records

from cvthead.errors import AssetError, InputError
from cvthead.training.checkpoint import averaged
from cvthead.training.config import TrainConfig
from cvthead.training.perceptual import perceptual_weights
from cvthead.training.renderers import training_parts
from cvthead.training.train import train
from cvthead.training.validation import CHOSEN_BY, Validation

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(autouse=True)
def _few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cvthead.training.renderers.VALIDATION_SAMPLES", 4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        perceptual_weights("alex")
    except AssetError as error:
        pytest.skip(f"no perceptual weights: {error}")
    path = tmp_path_factory.mktemp("records")
    make_records(path)
    return path


def configured(folder: Path, run: Path, **changes: Any) -> TrainConfig:
    values = {
        "data": folder,
        "run": run,
        "size": 64,
        "steps": 4,
        "batch": 1,
        "workers": 0,
        "log_every": 4,
        "save_every": 1,
        "average": 0.5,
        "precision": "32-true",
        "optimiser": {"learning_rate": 0.02},  # coarse enough to make some steps worse
    }
    return TrainConfig.model_validate(values | changes)


def scores(run: Path) -> dict[int, float]:
    """ST-LPIPS on the validation records, by step."""
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return {line["step"]: line[CHOSEN_BY] for line in lines if CHOSEN_BY in line}


def test_the_best_checkpoint_is_kept(folder: Path, tmp_path: Path) -> None:
    config = configured(folder, tmp_path / "run", validation=folder)
    train(config)
    found = scores(config.run)
    assert list(found) == [1, 2, 3, 4]
    best = torch.load(config.run / "best.pt", weights_only=True)
    assert best["step"] == min(found, key=lambda step: found[step])
    assert best["best"] == pytest.approx(min(found.values()), rel=1e-4)
    # Its averaged weights are those that were measured.
    _, renderer = training_parts(config)
    renderer.model.load_state_dict(averaged(best))
    again = Validation(Fabric(), config)(renderer, renderer.model)
    assert again[CHOSEN_BY] == pytest.approx(best["best"], rel=1e-4)


def test_a_break_forgets_no_best(folder: Path, tmp_path: Path) -> None:
    whole = configured(folder, tmp_path / "whole", validation=folder)
    parts = configured(folder, tmp_path / "parts", validation=folder)
    train(whole)
    for _ in range(2):
        train(parts, sitting=2)
    assert scores(parts.run) == pytest.approx(scores(whole.run), rel=1e-4)
    one, other = (torch.load(run / "best.pt", weights_only=True) for run in (whole.run, parts.run))
    assert one["step"] == other["step"]
    # A run that cannot beat an earlier best leaves it where it is.
    state = torch.load(parts.run / "checkpoint.pt", weights_only=True)
    torch.save(state | {"step": 3, "best": 0.0}, parts.run / "checkpoint.pt")
    (parts.run / "best.pt").unlink()
    train(parts)
    assert not (parts.run / "best.pt").exists()


def test_validation_does_not_change_what_is_learnt(folder: Path, tmp_path: Path) -> None:
    with_it = train(configured(folder, tmp_path / "with", validation=folder, steps=2))
    without = train(configured(folder, tmp_path / "without", steps=2))
    one, other = (torch.load(path, weights_only=True)["model"] for path in (with_it, without))
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert not (tmp_path / "without" / "best.pt").exists()


def test_validation_needs_records(folder: Path, tmp_path: Path) -> None:
    empty = tmp_path / "val"
    empty.mkdir()
    with pytest.raises(InputError, match=str(empty)):
        train(configured(folder, tmp_path / "run", validation=empty))
    shutil.rmtree(empty)
