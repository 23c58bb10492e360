"""Image encoder of the paper preset: ROME's weight-standardised network and the 2x2 patch tokens.

Layer order, widths and constants follow the released code, whose weights load into it.
"""

from __future__ import annotations

from einops import rearrange
from torch import Tensor, nn
from torch.nn import functional as F

GROUPS = 32
STEM_SIZE = 256
STAGES = ((64, 256), (128, 512), (256, 1024), (512, 2048))  # (inner, output) channels
PATCH = 2
PROJECTED_SIZE = 256


class StandardisedConv2d(nn.Conv2d):
    """Convolution whose filters are shifted to mean 0 and scaled to standard deviation 1.

    The deviation is the unbiased one, and the epsilon is added to it, not to the variance.
    """

    def forward(self, x: Tensor) -> Tensor:
        return F.conv2d(x, self.standardised(), self.bias, self.stride, self.padding)

    def standardised(self) -> Tensor:
        """The filters that :meth:`forward` applies."""
        centred = self.weight - self.weight.mean(dim=(1, 2, 3), keepdim=True)
        deviation = centred.std(dim=(1, 2, 3), keepdim=True, correction=1)
        weight: Tensor = centred / (deviation + 1e-5)
        return weight


class Bottleneck(nn.Module):
    """Pre-activation residual block; the skip sees the input before its normalisation."""

    def __init__(self, size_in: int, inner: int, size_out: int) -> None:
        super().__init__()
        self.main = nn.Sequential(
            *_norm_relu(size_in),
            StandardisedConv2d(size_in, inner, 1, bias=False),
            *_norm_relu(inner),
            StandardisedConv2d(inner, inner, 3, padding=1, bias=False),
            *_norm_relu(inner),
            StandardisedConv2d(inner, inner, 3, padding=1, bias=False),
            *_norm_relu(inner),
            nn.Conv2d(inner, size_out, 1, bias=False),
        )
        same = size_in == size_out
        self.skip = nn.Identity() if same else nn.Conv2d(size_in, size_out, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.main(x) + self.skip(x)
        return out


class RomeEncoder(nn.Module):
    """(b, 4, 256, 256) RGB in [-1, 1] and mask -> (b, 256, token_size), row-major tokens."""

    def __init__(self, token_size: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(4, STEM_SIZE, 7, padding=3, bias=False)]
        size = STEM_SIZE
        for stage, (inner, size_out) in enumerate(STAGES):
            if stage:
                layers.append(nn.MaxPool2d(2))
            layers += [Bottleneck(size, inner, size_out), Bottleneck(size_out, inner, size_out)]
            size = size_out
        self.net = nn.Sequential(*layers)
        self.project = nn.Conv2d(size, PROJECTED_SIZE, 1)
        self.to_token = nn.Linear(PATCH * PATCH * PROJECTED_SIZE, token_size)

    def forward(self, source: Tensor) -> Tensor:
        x = self.project(self.net(source))  # b c 32 32
        patches = rearrange(x, "b c (i p) (j q) -> b (i j) (p q c)", p=PATCH, q=PATCH)
        tokens: Tensor = self.to_token(patches)
        return tokens


def _norm_relu(size: int) -> tuple[nn.Module, nn.Module]:
    return nn.GroupNorm(min(GROUPS, size), size), nn.ReLU(inplace=False)
