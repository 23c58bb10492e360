"""How good a run's averaged weights are on people it does not learn from."""

from __future__ import annotations

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.func import functional_call

from cvthead.training.config import TrainConfig
from cvthead.training.losses import composite
from cvthead.training.perceptual import STLPIPS
from cvthead.training.renderers import Renderer, Samples, validation_samples

WHITE = 1.0
CHOSEN_BY = "validation_st_lpips"


class Validation:
    """The same samples every time, unchanged by augmentation.

    Raises:
        InputError: no records in ``config.validation``, or those of another preset.
        AssetError: the ST-LPIPS weights are not installed.
    """

    def __init__(self, fabric: Fabric, config: TrainConfig) -> None:
        self.device = fabric.device
        self.samples: Samples = validation_samples(config)
        self.distance = STLPIPS("alex", fused=True).to(fabric.device)

    @torch.no_grad()
    def __call__(self, renderer: Renderer, averaged: nn.Module) -> dict[str, float]:
        """Means over all views, which lie on white by the target's mask.

        `cvthead evaluate` does the same with what is served, whose colours beyond the own mask are
        not the network's (cvthead/runtime/edges.py): its figures are others.

        Args:
            renderer: of the network in training, which stays as it is.
            averaged: the weights to measure.

        Returns:
            ``validation_l1``, colours in -1..1, and CHOSEN_BY: ST-LPIPS.
        """
        weights = {f"model.{name}": value for name, value in averaged.state_dict().items()}
        training = renderer.training
        renderer.eval()
        found = []
        for number in range(len(self.samples)):
            sample = self.samples[number]
            batch = {name: value[None].to(self.device) for name, value in sample.items()}
            rgb, _ = functional_call(renderer, weights, (batch,))
            found.append(self._compared(rgb, batch))
        renderer.train(training)
        l1, distance = torch.stack(found).mean(0).tolist()
        return {"validation_l1": l1, CHOSEN_BY: distance}

    def _compared(self, rgb: Tensor, batch: dict[str, Tensor]) -> Tensor:
        image, mask, valid = (batch[name][0] for name in ("image", "mask", "valid"))
        shown, target = (
            composite(x, mask * valid, torch.full_like(x, WHITE)) for x in (rgb, image * 2 - 1)
        )
        return torch.stack([(shown - target).abs().mean(), self.distance(shown, target).mean()])
