"""Multi-scale patch discriminator and feature matching (Wang et al., pix2pixHD, 2018)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

SCALES = 2
SIZES = (64, 128, 256, 512)

Maps = list[list[Tensor]]  # of each scale, after each layer; the last are the patches' scores


def patch_discriminator() -> nn.ModuleList:
    """(b, 3, h, w) -> one score per patch of 70 x 70 pixels, in five layers."""
    first = nn.Sequential(nn.Conv2d(3, SIZES[0], 4, 2, 2), nn.LeakyReLU(0.2))
    layers: list[nn.Module] = [first]
    for number, (before, after) in enumerate(pairwise(SIZES), start=2):
        stride = 1 if number == len(SIZES) else 2
        layers.append(
            nn.Sequential(
                nn.Conv2d(before, after, 4, stride, 2), nn.InstanceNorm2d(after), nn.LeakyReLU(0.2)
            )
        )
    layers.append(nn.Conv2d(SIZES[-1], 1, 4, 1, 2))
    return nn.ModuleList(layers)


class MultiScaleDiscriminator(nn.Module):
    """The same discriminator, with its own weights, at full and at half size."""

    def __init__(self) -> None:
        super().__init__()
        self.scales = nn.ModuleList(patch_discriminator() for _ in range(SCALES))

    def forward(self, images: Tensor) -> Maps:
        """(b, 3, h, w) in [-1, 1] -> the outputs of every layer at every scale."""
        maps = []
        for layers in self.scales:
            assert isinstance(layers, nn.ModuleList)
            x, outputs = images, []
            for layer in layers:
                x = layer(x)
                outputs.append(x)
            maps.append(outputs)
            images = F.avg_pool2d(images, 3, 2, 1, count_include_pad=False)
        return maps


def discriminator_loss(real: Maps, fake: Maps) -> Tensor:
    """Least squares: scores of real views towards 1, of rendered ones towards 0."""
    terms = [(scale[-1].float() - 1).square().mean() for scale in real]
    terms += [scale[-1].float().square().mean() for scale in fake]
    return torch.stack(terms).mean()


def adversarial_losses(real: Maps, fake: Maps) -> dict[str, Tensor]:
    """What the renderer is to make small: ``adversarial``, scores of rendered views off 1, and
    ``feature_matching``, the L1 distance of the layers' outputs; means over the scales."""
    adversarial = [(scale[-1].float() - 1).square().mean() for scale in fake]
    matching = [_distance(r[:-1], f[:-1]) for r, f in zip(real, fake, strict=True)]
    return {
        "adversarial": torch.stack(adversarial).mean(),
        "feature_matching": torch.stack(matching).mean(),
    }


def _distance(real: Sequence[Tensor], fake: Sequence[Tensor]) -> Tensor:
    pairs = zip(real, fake, strict=True)
    return torch.stack([(r.detach() - f).abs().float().mean() for r, f in pairs]).mean()
