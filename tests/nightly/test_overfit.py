"""The open preset, from random weights, learns one clip by heart: 30 dB.

    scripts/nightly -k heart

The clip is the sample portrait as the shipped model animates it, over white: head turned, jaw and
smile, on shoulders that stand still, as in a call. It is tracked and cut like any other video.
Every frame is driven from the first, as it is: nothing is mirrored or recoloured. PSNR is over the
whole view, the result by its own mask over the same plain background as the target, pixels beyond
the edge of the picture left out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_records import PORTRAIT

from cvthead import Controls, Pipeline
from cvthead.head.model import HeadModel
from cvthead.images import read_image
from cvthead.points import PointLayout
from cvthead.source import HeadCrop, cut_head, read_source
from cvthead.training import records
from cvthead.training.checkpoint import read
from cvthead.training.config import LossWeights, Optimiser, TrainConfig
from cvthead.training.dataset import PairDataset
from cvthead.training.export import averaged_model
from cvthead.training.losses import compared_views
from cvthead.training.renderers import OpenRenderer
from cvthead.training.train import per_view, train

FRAMES = 8
STEPS = 1500
DECIBELS = 30.0
SAMPLES = 8

pytestmark = pytest.mark.nightly


def make_clip(folder: Path) -> None:
    """One record of FRAMES frames, the first of which is the source."""
    pipeline = Pipeline.load()
    tracker = pipeline.tracker
    avatar = pipeline.encode(read_image(PORTRAIT))
    shape = avatar.coefficients.shape
    heads: list[HeadCrop] = []
    for share in np.linspace(0, 1, FRAMES):
        smile = {"mouthSmileLeft": 1 - share, "mouthSmileRight": 1 - share}
        controls = Controls(
            global_rotation=(0, 0.4 * share - 0.1, 0), arkit={"jawOpen": 0.5 * share} | smile
        )
        picture = pipeline.render(avatar, controls).over((255, 255, 255))
        head = cut_head(tracker, picture, tracker.track(picture, shape=shape))
        heads.append(replace(head, coefficients=replace(head.coefficients, shape=shape)))
    source = read_source(pipeline.deformer, PointLayout.of(tracker.head), heads[0])
    records.write(folder / "clip.npz", heads, {0: source})


def test_one_clip_is_learnt_by_heart(tmp_path: Path, part: float) -> None:
    make_clip(tmp_path)
    config = TrainConfig(
        data=tmp_path,
        run=tmp_path / "run",
        size=128,
        steps=max(2, round(STEPS * part)),
        batch=2,
        freeze_norm=0.2,
        average=0.99,
        augmentation=False,
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
    renderer = OpenRenderer(averaged_model(read(checkpoint))).eval()
    layout = PointLayout.of(head)
    dataset = PairDataset(
        config.data, head, layout, size=config.size, seed=0, samples=SAMPLES, augment=False
    )
    errors = []
    with torch.inference_mode():
        for number in range(SAMPLES):
            batch = {name: value[None] for name, value in dataset[number].items()}
            rgb, logits = renderer(batch)
            shown, target = compared_views(rgb, logits, per_view(batch), stage=1)
            errors.append(((shown.clamp(-1, 1) - target) / 2).square().mean())
    return float(-10 * torch.stack(errors).mean().log10())
