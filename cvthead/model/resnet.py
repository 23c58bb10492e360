"""Residual trunks (He et al. 2016) under torchvision's parameter names, which checkpoints carry."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional as F

STAGE_SIZES = (64, 128, 256, 512)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a skip; ResNet-18's block."""

    expansion = 1

    def __init__(self, size_in: int, inner: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(size_in, inner, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(inner)
        self.conv2 = nn.Conv2d(inner, inner, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(inner)
        self.downsample = _shortcut(size_in, inner, stride)

    def forward(self, x: Tensor) -> Tensor:
        out = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(out)) + self.downsample(x))


class BottleneckBlock(nn.Module):
    """1x1, 3x3 (which carries the stride), 1x1 and a skip; ResNet-50's block."""

    expansion = 4

    def __init__(self, size_in: int, inner: int, stride: int) -> None:
        super().__init__()
        size_out = inner * self.expansion
        self.conv1 = nn.Conv2d(size_in, inner, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(inner)
        self.conv2 = nn.Conv2d(inner, inner, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(inner)
        self.conv3 = nn.Conv2d(inner, size_out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(size_out)
        self.downsample = _shortcut(size_in, size_out, stride)

    def forward(self, x: Tensor) -> Tensor:
        out = F.relu(self.bn1(self.conv1(x)))
        out = F.relu(self.bn2(self.conv2(out)))
        return F.relu(self.bn3(self.conv3(out)) + self.downsample(x))


class ResNet(nn.Module):
    """(b, 3, h, w) -> the feature maps after each of the four stages, at 1/4 to 1/32.

    Args:
        block: BasicBlock or BottleneckBlock.
        depths: blocks of each stage.
        classes: with a number, ``fc`` maps the mean of the last stage to it (:meth:`classify`).
    """

    def __init__(
        self,
        block: type[BasicBlock] | type[BottleneckBlock],
        depths: Sequence[int],
        classes: int = 0,
    ) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        size = 64
        for number, (depth, inner) in enumerate(zip(depths, STAGE_SIZES, strict=True), start=1):
            blocks = []
            for index in range(depth):
                stride = 2 if number > 1 and index == 0 else 1
                blocks.append(block(size, inner, stride))
                size = inner * block.expansion
            self.add_module(f"layer{number}", nn.Sequential(*blocks))
        self.fc = nn.Linear(size, classes) if classes else nn.Identity()

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(image))), 3, 2, 1)
        maps = []
        for number in range(1, len(STAGE_SIZES) + 1):
            x = self.get_submodule(f"layer{number}")(x)
            maps.append(x)
        return tuple(maps)

    def pooled(self, image: Tensor) -> Tensor:
        """(b, 3, h, w) -> (b, size) mean of the last stage."""
        return self(image)[-1].mean(dim=(2, 3))  # type: ignore[no-any-return]

    def classify(self, image: Tensor) -> Tensor:
        """(b, 3, h, w) -> (b, classes)."""
        return self.fc(self.pooled(image))  # type: ignore[no-any-return]


def resnet18() -> ResNet:
    return ResNet(BasicBlock, (2, 2, 2, 2))


def resnet50(classes: int = 0) -> ResNet:
    return ResNet(BottleneckBlock, (3, 4, 6, 3), classes)


def _shortcut(size_in: int, size_out: int, stride: int) -> nn.Module:
    if stride == 1 and size_in == size_out:
        return nn.Identity()
    return nn.Sequential(
        nn.Conv2d(size_in, size_out, 1, stride, bias=False), nn.BatchNorm2d(size_out)
    )
