"""U-Net of the open preset: works at half resolution, finishes at full resolution."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvthead.model.layers import conv_bn_relu, upsample
from cvthead.runtime.mix import EVEN

PIXEL_SIZE = 8  # channels at full resolution
PORTRAIT_SIZE = 4  # RGB and mask
GATE_BIAS = 1.0  # the warped portrait is trusted until training says where not to
SLOPE = 0.01
# Share of training views painted without the warped portrait. Where the gate trusts it, nothing
# else would teach the painted picture, and its noise would show wherever the gate wavers.
GATE_DROPOUT = 0.2


def clipped(colour: Tensor) -> Tensor:
    """Colour to [-1, 1], with a slope outside that lets training come back.

    Unlike tanh this leaves grey levels evenly spaced, so an 8-bit network can end with it.
    """
    inside = colour.clamp(-1, 1)
    return inside + SLOPE * (colour - inside)


def even(image: Tensor) -> Tensor:
    """Filter by EVEN both ways: pixels come in blocks of two by two, and no loss keeps the four
    from drifting apart, which shows as dots. This filter passes nothing of that pattern, and of
    what is coarser than three pixels nearly everything."""
    channels = image.shape[1]
    line = torch.tensor(EVEN, device=image.device)
    kernel = torch.outer(line, line).expand(channels, 1, -1, -1)
    edge = len(EVEN) // 2
    return F.conv2d(F.pad(image, (edge,) * 4, "reflect"), kernel, groups=channels)


class LightUNet(nn.Module):
    """Filled splat and warped portrait -> RGB and mask logits."""

    def __init__(self, size_in: int, sizes: Sequence[int], unshuffle: int) -> None:
        super().__init__()
        self.unshuffle = unshuffle
        self.stem = conv_bn_relu(size_in + PORTRAIT_SIZE * unshuffle**2, sizes[0], kernel=1)
        self.downs = nn.ModuleList([conv_bn_relu(sizes[0], sizes[0])])
        for before, size in pairwise(sizes):
            self.downs.append(
                nn.Sequential(nn.MaxPool2d(2), conv_bn_relu(before, size), conv_bn_relu(size, size))
            )
        self.laterals = nn.ModuleList()
        self.ups = nn.ModuleList()
        before = sizes[-1]
        for size in reversed(sizes[:-1]):
            self.laterals.append(conv_bn_relu(before, size, kernel=1))
            self.ups.append(nn.Sequential(conv_bn_relu(2 * size, size), conv_bn_relu(size, size)))
            before = size
        self.to_pixels = nn.Conv2d(before, PIXEL_SIZE * unshuffle**2, 3, padding=1)
        self.to_image = nn.Conv2d(PIXEL_SIZE + PORTRAIT_SIZE, 5, 3, padding=1)
        with torch.no_grad():
            assert self.to_image.bias is not None
            self.to_image.bias[4] += GATE_BIAS

    def forward(
        self, splat: Tensor, warped: Tensor, *, carry: bool = True
    ) -> tuple[Tensor, Tensor]:
        """Paint a frame.

        Args:
            splat: (b, size_in, h / unshuffle, w / unshuffle).
            warped: (b, 4, h, w), the portrait's RGB in [-1, 1] and mask, carried to the pose.
            carry: False does without the warped portrait: an ablation.

        Returns:
            RGB (b, 3, h, w) in [-1, 1], a little beyond beside sharp edges: warped pixels and
            painted ones, mixed by a learned gate; mask logits (b, 1, h, w).
        """
        painted, logits, gate = self.parts(splat, warped, carry=carry)
        if self.training:
            gate = gate * (torch.rand(len(gate), 1, 1, 1) > GATE_DROPOUT)
        return gate * warped[:, :3] + (1 - gate) * painted, logits

    def parts(
        self, splat: Tensor, warped: Tensor, *, carry: bool = True
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The painted RGB (b, 3, h, w), mask logits (b, 1, h, w), and how far the warped portrait
        is shown instead (b, 1, h, w), 0..1; arguments as :meth:`forward`."""
        if not carry:
            warped = torch.zeros_like(warped)
        x = self.stem(torch.cat([splat, F.pixel_unshuffle(warped, self.unshuffle)], dim=1))
        x = F.pixel_shuffle(self.after_stem(x), self.unshuffle)
        # 0..1, so that the zeros beyond the border are black and transparent.
        portrait = torch.cat([warped[:, :3] * 0.5 + 0.5, warped[:, 3:]], dim=1) * carry
        out = self.to_image(torch.cat([x, portrait.to(x.dtype)], dim=1)).float()
        out = even(torch.cat([clipped(out[:, :3]), out[:, 3:]], dim=1))
        return out[:, :3], out[:, 3:4], torch.sigmoid(out[:, 4:]) * carry

    def after_stem(self, x: Tensor) -> Tensor:
        """The stem's output (b, sizes[0], h / u, w / u) -> (b, PIXEL_SIZE * u * u, h / u, w / u),
        the features of each pixel, not yet shuffled to the picture's size."""
        skips = []
        for down in self.downs:
            x = down(x)
            skips.append(x)
        for lateral, up, skip in zip(self.laterals, self.ups, reversed(skips[:-1]), strict=True):
            x = up(torch.cat([upsample(lateral(x)), skip], dim=1))
        return F.relu(self.to_pixels(x))
