"""Building blocks shared by the open preset's encoder and U-Net."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F


def conv_bn_relu(size_in: int, size_out: int, stride: int = 1, kernel: int = 3) -> nn.Sequential:
    """Convolution whose batch norm folds into it for inference."""
    return nn.Sequential(
        nn.Conv2d(size_in, size_out, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(size_out),
        nn.ReLU(inplace=True),
    )


def upsample(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
