"""The training loop on a record of the sample portrait."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cvthead.deformation import DeformationModel
from cvthead.errors import AssetError
from cvthead.head.model import HeadModel
from cvthead.images import read_image
from cvthead.points import PointLayout
from cvthead.source import cut_head, read_source
from cvthead.tracking.tracker import Tracker
from cvthead.training import records
from cvthead.training.dataset import PairDataset, flip_order, flip_points
from cvthead.training.perceptual import perceptual_weights
from cvthead.training.train import TrainConfig, train

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.load()


@pytest.fixture(scope="module")
def layout(head: HeadModel) -> PointLayout:
    return PointLayout.of(head)


@pytest.fixture(scope="module")
def folder(head: HeadModel, layout: PointLayout, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("records")
    tracker = Tracker.load(head)
    image = read_image(PORTRAIT)
    crop = cut_head(tracker, image, tracker.track(image))
    source = read_source(DeformationModel.from_head(head), layout, crop)
    records.write(path / "portrait.npz", [crop], {0: source})
    stored = records.Record.open(path / "portrait.npz")
    assert np.array_equal(stored.visible(0, layout.total), source.visible)
    assert np.allclose(stored.deformation(0).offsets, source.deformation.offsets, atol=1e-4)
    assert np.abs(stored.frame(0).image.astype(int) - crop.image).mean() < 3
    return path


def test_a_sample_depends_on_seed_and_number_alone(
    folder: Path, head: HeadModel, layout: PointLayout
) -> None:
    def dataset(seed: int) -> PairDataset:
        return PairDataset(folder, head, layout, size=64, seed=seed, samples=8)

    first, again, other = dataset(1)[3], dataset(1)[3], dataset(2)[3]
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["source"], other["source"])


def test_flip_is_its_own_inverse(layout: PointLayout) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(layout.total, 3)).astype(np.float32)
    assert np.array_equal(flip_points(flip_points(points, layout), layout), points)
    assert not np.array_equal(flip_order(points, layout), points)


def test_resumed_run_equals_one_without_a_break(folder: Path, tmp_path: Path) -> None:
    try:
        perceptual_weights("alex")
    except AssetError as error:
        pytest.skip(f"no perceptual weights: {error}")
    config = TrainConfig(size=64, steps=4, batch=1, learning_rate=1e-3, freeze_norm=0.5)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train(config, folder, whole)
    train(config, folder, parts, sitting=2)
    assert torch.load(parts / "checkpoint.pt", weights_only=True)["step"] == 2
    train(config, folder, parts)
    states = [torch.load(run / "checkpoint.pt", weights_only=True) for run in (whole, parts)]
    assert states[0]["step"] == states[1]["step"] == 4
    for name, value in states[0]["averaged"].items():
        torch.testing.assert_close(states[1]["averaged"][name], value, rtol=1e-4, atol=1e-5)
    assert (parts / "samples.png").is_file()
