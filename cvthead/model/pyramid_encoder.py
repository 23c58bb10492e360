"""Image encoder of the open preset: tokens at stride 16, pixel-aligned features at stride 2."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cvthead.model.layers import conv_bn_relu, upsample


class PyramidEncoder(nn.Module):
    """A small feature pyramid; both outputs are computed once per source."""

    def __init__(self, token_size: int, pixel_size: int) -> None:
        super().__init__()
        self.down1 = conv_bn_relu(4, 24, stride=2)
        self.down2 = nn.Sequential(conv_bn_relu(24, 48, stride=2), conv_bn_relu(48, 48))
        self.down3 = nn.Sequential(conv_bn_relu(48, 96, stride=2), conv_bn_relu(96, 96))
        self.down4 = nn.Sequential(conv_bn_relu(96, 160, stride=2), conv_bn_relu(160, 160))
        self.to_tokens = nn.Conv2d(160, token_size, 1)
        self.lateral4 = conv_bn_relu(160, 96, kernel=1)
        self.up3 = conv_bn_relu(192, 96)
        self.lateral3 = conv_bn_relu(96, 48, kernel=1)
        self.up2 = conv_bn_relu(96, 48)
        self.lateral2 = conv_bn_relu(48, 32, kernel=1)
        self.up1 = conv_bn_relu(56, 32)
        self.to_pixels = nn.Conv2d(32, pixel_size, 1)

    def forward(self, source: Tensor) -> tuple[Tensor, Tensor]:
        """Args: source: (b, 4, 256, 256), RGB in [-1, 1] and mask.

        Returns:
            tokens (b, 256, token_size) row-major, pixel features (b, pixel_size, 128, 128).
        """
        x1 = self.down1(source)  # b 24 128 128
        x2 = self.down2(x1)  # b 48 64 64
        x3 = self.down3(x2)  # b 96 32 32
        x4 = self.down4(x3)  # b 160 16 16
        tokens = self.to_tokens(x4).flatten(2).transpose(1, 2)
        y = self.up3(torch.cat([upsample(self.lateral4(x4)), x3], dim=1))
        y = self.up2(torch.cat([upsample(self.lateral3(y)), x2], dim=1))
        y = self.up1(torch.cat([upsample(self.lateral2(y)), x1], dim=1))
        return tokens, self.to_pixels(y)
