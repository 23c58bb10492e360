"""Plain training loop of the open preset.

    python -m cvthead.training.train RECORDS RUN --size 128 --steps 4000

A run is a folder with ``checkpoint.pt`` (resumed from when present), ``log.jsonl`` and sample
pictures. Stages at growing sizes share a run: start the next one with ``--init``.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from einops import rearrange, repeat
from torch import Tensor, nn
from torch.utils.data import DataLoader, Subset

from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.points import PointLayout
from cvthead.training.dataset import VIEWS, PairDataset
from cvthead.training.losses import LossWeights, composite, reconstruction_losses
from cvthead.training.perceptual import STLPIPS


@dataclass(frozen=True)
class TrainConfig:
    """One stage of training.

    Attributes:
        size: rendered height and width in pixels.
        steps: length of the stage; the learning rate falls to a fiftieth over its second half.
        batch: sources per step, each with VIEWS driven views.
        learning_rate: peak, after a warm-up of 100 steps.
        freeze_norm: share of the steps after which batch-norm statistics stay fixed, so that the
            network is trained as it will be run.
        average: decay of the averaged weights that are kept.
        seed: of weights and samples.
    """

    size: int
    steps: int
    batch: int
    learning_rate: float
    freeze_norm: float = 0.6
    average: float = 0.998
    seed: int = 0


def learning_rate(config: TrainConfig, step: int) -> float:
    warm = min(1.0, (step + 1) / 100)
    late = max(0.0, (step / config.steps - 0.5) * 2)
    return (
        config.learning_rate * warm * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(late, 1))))
    )


def averaging(decay: float) -> Callable[[Any, Any, Any], None]:
    """Moving average whose window grows from nothing, so that a short run forgets its start."""

    def update(averaged: Any, current: Any, count: Any) -> None:
        rate = min(decay, (1 + int(count)) / (10 + int(count)))
        torch.optim.swa_utils.get_ema_multi_avg_fn(rate)(averaged, current, count)  # type: ignore[no-untyped-call]

    return update


def freeze_norms(model: nn.Module) -> None:
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def render_views(model: CVTHead, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    descriptors = model.describe(
        batch["source"], batch["points"], batch["visible"], batch["anchor"]
    )
    descriptors = repeat(descriptors, "b p c -> (b v) p c", v=VIEWS)
    driven = rearrange(batch["driven"], "b v p c -> (b v) p c")
    return model.paint(driven, descriptors, rearrange(batch["warped"], "b v ... -> (b v) ..."))


def train(
    config: TrainConfig,
    records: Path,
    run: Path,
    *,
    init: Path | None = None,
    sitting: int | None = None,
) -> None:
    """Train one stage, resuming from ``run/checkpoint.pt`` when it exists.

    Args:
        config: the stage.
        records: folder made by cvthead.training.prepare.
        run: folder of the run.
        init: checkpoint of an earlier stage, whose weights are the start.
        sitting: stop after this many steps, to go on another time; None runs to the end.
    """
    torch.manual_seed(config.seed)
    torch.set_num_threads(2)
    run.mkdir(parents=True, exist_ok=True)
    head = HeadModel.load()
    layout = PointLayout.of(head)
    model = CVTHead(OPEN, MeshHierarchy.load(), layout)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    averaged = torch.optim.swa_utils.AveragedModel(
        model,
        multi_avg_fn=averaging(config.average),
        use_buffers=True,
    )
    optimizer = torch.optim.AdamW(
        model.parameters(), config.learning_rate, betas=(0.9, 0.99), weight_decay=1e-4
    )
    perceptual = STLPIPS("alex", fused=True)
    weights = LossWeights()
    step = 0
    checkpoint = run / "checkpoint.pt"
    if checkpoint.exists():
        state: dict[str, Any] = torch.load(checkpoint, weights_only=True)
        model.load_state_dict(state["model"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        step = state["step"]
    elif init is not None:
        state = torch.load(init, weights_only=True)
        model.load_state_dict(state["model"])
        averaged.module.load_state_dict(state["model"])
    dataset = PairDataset(
        records,
        head,
        layout,
        size=config.size,
        seed=config.seed + config.size,
        samples=config.steps * config.batch,
    )
    first = step
    last = config.steps if sitting is None else min(config.steps, first + sitting)
    rest = Subset(dataset, range(first * config.batch, last * config.batch))
    loader = DataLoader(rest, config.batch, num_workers=1, prefetch_factor=4)
    log = (run / "log.jsonl").open("a")
    (run / "config.json").write_text(json.dumps(asdict(config), indent=2))
    running: dict[str, float] = {}
    model.train()
    saved = started = time.monotonic()
    for batch in loader:
        if step >= config.freeze_norm * config.steps:
            freeze_norms(model)
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(config, step)
        with torch.autocast("cpu", torch.bfloat16):
            rgb, logits = render_views(model, batch)
            views = {
                name: rearrange(batch[name], "b v ... -> (b v) ...")
                for name in ("image", "mask", "valid", "background", "weight", "zoom")
            } | {"window": batch["window"]}
            losses = reconstruction_losses(rgb, logits, views, perceptual)
        total = torch.stack([getattr(weights, k) * v for k, v in losses.items()]).sum()
        optimizer.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        averaged.update_parameters(model)
        step += 1
        for name, value in losses.items():
            now = float(value.detach())
            running[name] = running.get(name, now) * 0.98 + now * 0.02
        if step % 50 == 0:
            seconds = (time.monotonic() - started) / (step - first)
            line = {"step": step, "seconds_per_step": round(seconds, 3)} | {
                name: round(value, 4) for name, value in running.items()
            }
            print(json.dumps(line), file=log, flush=True)
        if time.monotonic() - saved > 300 or step == last:
            saved = time.monotonic()
            save(checkpoint, model, averaged, optimizer, step)
            save_picture(run / "samples.png", batch, rgb, logits)
    log.close()


def save(
    path: Path, model: nn.Module, averaged: nn.Module, optimizer: torch.optim.Optimizer, step: int
) -> None:
    state = {
        "model": model.state_dict(),
        "averaged": averaged.state_dict(),
        "optimizer": optimizer.state_dict(),
        "step": step,
    }
    temporary = path.with_suffix(".tmp")
    torch.save(state, temporary)
    temporary.rename(path)


def save_picture(path: Path, batch: dict[str, Tensor], rgb: Tensor, logits: Tensor) -> None:
    """Rows of source, then target and result of each view."""
    size = rgb.shape[-1]
    source = nn.functional.interpolate(batch["source"][:, :3], (size, size)) * 0.5 + 0.5
    target = composite(batch["image"], batch["mask"], torch.ones(()))
    own = composite(rgb.detach() * 0.5 + 0.5, logits.detach().sigmoid(), torch.ones(()))
    own = rearrange(own, "(b v) c h w -> b v c h w", v=VIEWS)
    columns = [source] + [x[:, v] for v in range(VIEWS) for x in (target, own)]
    grid = rearrange(torch.stack(columns), "n b c h w -> (b h) (n w) c")
    pixels = (grid.float().clamp(0, 1).numpy() * 255).astype(np.uint8)
    cv2.imwrite(str(path), np.ascontiguousarray(pixels[..., ::-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("records", type=Path, help="folder made by cvthead.training.prepare")
    parser.add_argument("run", type=Path, help="folder of the run")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--learning-rate", type=float, default=5e-4)
    parser.add_argument("--init", type=Path, help="checkpoint of an earlier stage")
    parser.add_argument("--sitting", type=int, help="stop after this many steps; resume later")
    a = parser.parse_args()
    config = TrainConfig(a.size, a.steps, a.batch, a.learning_rate)
    train(config, a.records, a.run, init=a.init, sitting=a.sitting)


if __name__ == "__main__":
    main()
