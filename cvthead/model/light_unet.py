"""U-Net of the open preset: works at half resolution behind a pixel unshuffle."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvthead.model.layers import conv_bn_relu, upsample

HEAD_SIZE = 16


class LightUNet(nn.Module):
    """Splat -> RGB and mask logits, at a third of the paper U-Net's multiplications."""

    def __init__(self, size_in: int, sizes: Sequence[int], unshuffle: int) -> None:
        super().__init__()
        self.unshuffle = unshuffle
        self.stem = conv_bn_relu(size_in * unshuffle**2, sizes[0], kernel=1)
        self.downs = nn.ModuleList()
        before = sizes[0]
        for size in sizes:
            self.downs.append(nn.Sequential(conv_bn_relu(before, size), conv_bn_relu(size, size)))
            before = size
        self.laterals = nn.ModuleList()
        self.ups = nn.ModuleList()
        for size in reversed(sizes[:-1]):
            self.laterals.append(conv_bn_relu(before, size, kernel=1))
            self.ups.append(nn.Sequential(conv_bn_relu(2 * size, size), conv_bn_relu(size, size)))
            before = size
        self.to_shuffle = nn.Conv2d(before, HEAD_SIZE * unshuffle**2, 3, padding=1)
        self.refine = nn.Conv2d(HEAD_SIZE, HEAD_SIZE, 3, padding=1)
        self.to_image = nn.Conv2d(HEAD_SIZE, 4, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(b, size_in, h, w) -> (b, 4, h, w): RGB and mask before tanh and sigmoid."""
        x = self.stem(F.pixel_unshuffle(x, self.unshuffle))
        skips = []
        for level, down in enumerate(self.downs):
            x = down(F.max_pool2d(x, 2) if level else x)
            skips.append(x)
        for lateral, up, skip in zip(self.laterals, self.ups, reversed(skips[:-1]), strict=True):
            x = up(torch.cat([upsample(lateral(x)), skip], dim=1))
        x = F.relu(F.pixel_shuffle(self.to_shuffle(x), self.unshuffle))
        out: Tensor = self.to_image(F.relu(self.refine(x)))
        return out
