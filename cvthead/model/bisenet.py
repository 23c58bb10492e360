"""Face parsing, the paper preset's foreground mask (BiSeNet, Yu et al. 2018; paper section 3.3).

Attribute names are those of the released weights.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvthead.model.resnet import resnet18

CLASSES = 19
BACKGROUND = 0
PARSED_SIZE = 512
# The 1/8 and 1/16 heads that only training uses; the checkpoint carries them.
AUXILIARY_HEADS = ("net.conv_out16.", "net.conv_out32.")


class ConvBnRelu(nn.Module):
    def __init__(self, size_in: int, size_out: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(size_in, size_out, kernel, padding=kernel // 2, bias=False)
        self.bn = nn.BatchNorm2d(size_out)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)))


class AttentionRefinement(nn.Module):
    """Weighs channels by a gate of their global mean."""

    def __init__(self, size_in: int, size_out: int) -> None:
        super().__init__()
        self.conv = ConvBnRelu(size_in, size_out, 3)
        self.conv_atten = nn.Conv2d(size_out, size_out, 1, bias=False)
        self.bn_atten = nn.BatchNorm2d(size_out)

    def forward(self, x: Tensor) -> Tensor:
        features = self.conv(x)
        gate = torch.sigmoid(self.bn_atten(self.conv_atten(_global_mean(features))))
        out: Tensor = features * gate
        return out


class ContextPath(nn.Module):
    """(b, 3, 512, 512) -> trunk features at 1/8 (128) and refined context at 1/8 (128)."""

    def __init__(self) -> None:
        super().__init__()
        self.resnet = resnet18()
        self.arm16 = AttentionRefinement(256, 128)
        self.arm32 = AttentionRefinement(512, 128)
        self.conv_head32 = ConvBnRelu(128, 128, 3)
        self.conv_head16 = ConvBnRelu(128, 128, 3)
        self.conv_avg = ConvBnRelu(512, 128, 1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        _, at8, at16, at32 = self.resnet(x)
        context = self.arm32(at32) + self.conv_avg(_global_mean(at32))
        context = self.conv_head32(_nearest(context, at16))
        context = self.arm16(at16) + context
        return at8, self.conv_head16(_nearest(context, at8))


class FeatureFusion(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.convblk = ConvBnRelu(256, 256, 1)
        self.conv1 = nn.Conv2d(256, 64, 1, bias=False)
        self.conv2 = nn.Conv2d(64, 256, 1, bias=False)

    def forward(self, trunk: Tensor, context: Tensor) -> Tensor:
        features = self.convblk(torch.cat([trunk, context], dim=1))
        gate = torch.sigmoid(self.conv2(F.relu(self.conv1(_global_mean(features)))))
        out: Tensor = features + features * gate
        return out


class Head(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv = ConvBnRelu(256, 256, 3)
        self.conv_out = nn.Conv2d(256, CLASSES, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.conv_out(self.conv(x))
        return out


class BiSeNet(nn.Module):
    """(b, 3, 512, 512) normalised picture -> (b, 19, 512, 512) class logits."""

    def __init__(self) -> None:
        super().__init__()
        self.cp = ContextPath()
        self.ffm = FeatureFusion()
        self.conv_out = Head()

    def forward(self, x: Tensor) -> Tensor:
        logits = self.conv_out(self.ffm(*self.cp(x)))
        return F.interpolate(logits, x.shape[2:], mode="bilinear", align_corners=True)


class FaceParsing(nn.Module):
    """Foreground mask of a portrait, as the released code takes it from BiSeNet."""

    mean: Tensor  # (3,) of ImageNet's pictures
    std: Tensor  # (3,)

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406]))
        self.register_buffer("std", torch.tensor([0.229, 0.224, 0.225]))
        self.net = BiSeNet()

    def forward(self, image: Tensor) -> Tensor:
        """(b, 3, h, w) RGB in [-1, 1] -> (b, 19, h, w) logits."""
        x = (0.5 * (image + 1) - self.mean[:, None, None]) / self.std[:, None, None]
        x = F.interpolate(x, (PARSED_SIZE,) * 2, mode="bilinear", align_corners=False)
        return F.interpolate(self.net(x), image.shape[2:], mode="bilinear", align_corners=False)

    def mask(self, image: Tensor) -> Tensor:
        """(b, 3, h, w) RGB in [-1, 1] -> (b, 1, h, w), 1 where anything but background is."""
        return foreground(self(image))


def foreground(logits: Tensor) -> Tensor:
    """(b, 19, h, w) -> (b, 1, h, w) of 0 and 1; hair, hats, neck and clothes are foreground."""
    return (logits.argmax(dim=1, keepdim=True) != BACKGROUND).to(logits.dtype)


def _global_mean(x: Tensor) -> Tensor:
    return x.mean(dim=(2, 3), keepdim=True)


def _nearest(x: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(x, like.shape[2:], mode="nearest")
