"""How a run changes with its steps: learning rate, averaged weights, batch norm."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from cvthead.training.config import Optimiser

LOWEST = 0.02  # of the peak, at the end of "late-cosine"


def learning_rate(optimiser: Optimiser, step: int, steps: int) -> float:
    """Of a step from 0 to ``steps`` - 1."""
    rate = optimiser.learning_rate
    if optimiser.warm_up:
        rate *= min(1.0, (step + 1) / optimiser.warm_up)
    if optimiser.schedule == "late-cosine":
        late = min(1.0, max(0.0, (step / steps - 0.5) * 2))
        rate *= LOWEST + (1 - LOWEST) * 0.5 * (1 + math.cos(math.pi * late))
    return rate


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
