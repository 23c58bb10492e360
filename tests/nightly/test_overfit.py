"""The open preset learns one clip by heart: 30 dB."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from made_records import make_records

from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.points import PointLayout
from cvthead.training.checkpoint import read
from cvthead.training.config import LossWeights, Optimiser, TrainConfig
from cvthead.training.dataset import PairDataset
from cvthead.training.losses import compared_views
from cvthead.training.renderers import OpenRenderer
from cvthead.training.train import per_view, train

STEPS = 1500
DECIBELS = 30.0
SAMPLES = 8

pytestmark = pytest.mark.nightly


def test_one_clip_is_learnt_to_30_db(tmp_path: Path, part: float) -> None:
    make_records(tmp_path, views=6)
    config = TrainConfig(
        data=tmp_path,
        run=tmp_path / "run",
        size=128,
        steps=round(STEPS * part),
        batch=2,
        freeze_norm=0.6,
        average=0.99,
        losses=LossWeights(perceptual=0.5),
        optimiser=Optimiser(
            name="adamw", learning_rate=1e-3, warm_up=20, schedule="late-cosine", clip_norm=1.0
        ),
    )
    reached = psnr(config, train(config))
    print(f"PSNR {reached:.1f} dB")
    if part == 1:
        assert reached >= DECIBELS


def psnr(config: TrainConfig, checkpoint: Path) -> float:
    """Of the averaged weights on samples of the clip; dB, over the driven views."""
    head = HeadModel.load()
    layout = PointLayout.of(head)
    model = CVTHead(OPEN, MeshHierarchy.load(), layout)
    averaged = read(checkpoint)["averaged"]
    model.load_state_dict(
        {k.removeprefix("module."): v for k, v in averaged.items() if k.startswith("module.")}
    )
    renderer = OpenRenderer(model).eval()
    dataset = PairDataset(config.data, head, layout, size=config.size, seed=0, samples=SAMPLES)
    errors = []
    with torch.inference_mode():
        for number in range(SAMPLES):
            batch = {name: value[None] for name, value in dataset[number].items()}
            rgb, logits = renderer(batch)
            shown, target = compared_views(rgb, logits, per_view(batch), stage=1)
            errors.append(((shown.clamp(-1, 1) - target) / 2).square().mean())
    return float(-10 * torch.stack(errors).mean().log10())
