"""The loss of a configuration: which terms, by which frozen networks."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from cvthead.training.config import ST_LPIPS, TrainConfig
from cvthead.training.discriminator import MultiScaleDiscriminator, adversarial_losses
from cvthead.training.identity import IdentityDistance
from cvthead.training.losses import compared_views, paper_losses, reconstruction_losses
from cvthead.training.perceptual import STLPIPS
from cvthead.training.vgg import VGGDistance


class Objective(nn.Module):
    """All terms of the loss.

    Raises:
        InputError: a file of weights that the user brings is missing or another network.
        AssetError: the ST-LPIPS weights are not installed.
    """

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        self.config = config
        chosen = config.networks.perceptual
        self.perceptual: nn.Module = (
            STLPIPS("alex", fused=True) if chosen == ST_LPIPS else VGGDistance(Path(chosen))
        )
        identity = config.networks.identity
        self.identity = IdentityDistance(identity) if identity and config.losses.identity else None

    def forward(
        self,
        rgb: Tensor,
        logits: Tensor,
        views: dict[str, Tensor],
        discriminator: MultiScaleDiscriminator | None,
    ) -> dict[str, Tensor]:
        """Every term as a scalar, by its name in LossWeights.

        Args:
            rgb, logits, views: see cvthead.training.losses.reconstruction_losses.
            discriminator: in stage 2; gets no gradient.
        """
        stage = self.config.stage
        if self.config.preset == "open":
            losses = reconstruction_losses(rgb, logits, views, self.perceptual)
        else:
            losses = paper_losses(rgb, logits, views, self.perceptual, stage)
        shown, target = compared_views(rgb, logits, views, stage)
        if self.identity is not None:
            losses["identity"] = self.identity(shown, target).mean()
        if discriminator is not None:
            discriminator.requires_grad_(False)
            with torch.no_grad():
                real = discriminator(target)
            losses |= adversarial_losses(real, discriminator(shown))
            discriminator.requires_grad_(True)
        return losses

    def total(self, losses: dict[str, Tensor]) -> Tensor:
        """Weighted sum."""
        weights = self.config.losses
        return torch.stack([getattr(weights, name) * v for name, v in losses.items()]).sum()
