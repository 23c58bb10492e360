"""The paper's U-Net: splat image -> RGB and mask (paper section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class ConvNorm(nn.Module):
    """3x3 convolution, batch norm, ReLU. The convolution keeps its (redundant) bias, for the
    released weights have one."""

    def __init__(self, size_in: int, size_out: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(size_in, size_out, 3, padding=1)
        self.norm = nn.BatchNorm2d(size_out)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.norm(self.conv(x)))


class Up(nn.Module):
    """Doubles the resolution, halves the channels and merges the skip."""

    def __init__(self, size_in: int, size_out: int) -> None:
        super().__init__()
        self.reduce = ConvNorm(size_in, size_out)
        self.merge = ConvNorm(2 * size_out, size_out)
        self.refine = ConvNorm(size_out, size_out)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=True)
        out: Tensor = self.refine(self.merge(torch.cat([self.reduce(x), skip], dim=1)))
        return out


class UNet(nn.Module):
    """(b, size_in, h, w) -> (b, size_out, h, w): RGB and mask before tanh and sigmoid.

    Height and width must be multiples of ``2 ** (len(sizes) - 1)``.
    """

    def __init__(self, size_in: int, sizes: Sequence[int], size_out: int = 4) -> None:
        super().__init__()
        before = [size_in, *sizes[:-1]]
        self.downs = nn.ModuleList(
            nn.Sequential(ConvNorm(a, b), ConvNorm(b, b))
            for a, b in zip(before, sizes, strict=True)
        )
        self.ups = nn.ModuleList(Up(a, b) for a, b in pairwise(reversed(sizes)))
        self.to_image = nn.Conv2d(sizes[0], size_out, 1)

    def forward(self, x: Tensor) -> Tensor:
        skips = []
        for level, down in enumerate(self.downs):
            x = down(F.max_pool2d(x, 2) if level else x)
            skips.append(x)
        for up, skip in zip(self.ups, reversed(skips[:-1]), strict=True):
            x = up(x, skip)
        out: Tensor = self.to_image(x)
        return out
