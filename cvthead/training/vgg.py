"""VGG perceptual loss (Johnson et al. 2016; layers and weights of pix2pixHD)."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from cvthead.training.frozen import fill, load_state

# Convolutions of each block; torchvision's configurations D and E.
BLOCKS = {"VGG-16": (2, 2, 3, 3, 3), "VGG-19": (2, 2, 4, 4, 4)}
SIZES = (64, 128, 256, 512, 512)
WEIGHTS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1.0)  # of the first feature map of each block
LAST_OF_VGG19 = "features.34.weight"
# Of torchvision's weights, for RGB in 0..1.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def vgg_features(blocks: tuple[int, ...]) -> nn.Sequential:
    """The convolutional part, numbered as torchvision's ``features``."""
    layers: list[nn.Module] = []
    before = 3
    for count, size in zip(blocks, SIZES, strict=True):
        for _ in range(count):
            layers += [nn.Conv2d(before, size, 3, padding=1), nn.ReLU()]
            before = size
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers)


class VGGDistance(nn.Module):
    """Weighted L1 distance of the first feature map of each VGG block.

    Args:
        path: state dict of torchvision's vgg16 or vgg19; its classifier is not needed.

    Raises:
        InputError: no such file, or not such a network.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, path: Path) -> None:
        super().__init__()
        state = load_state(path, "VGG")
        name = "VGG-19" if LAST_OF_VGG19 in state else "VGG-16"
        self.features = vgg_features(BLOCKS[name])
        kept = {
            key.removeprefix("features."): value
            for key, value in state.items()
            if key.startswith("features.")
        }
        fill(self.features, kept, path, name)
        for buffer, values in (("mean", MEAN), ("deviation", DEVIATION)):
            self.register_buffer(buffer, torch.tensor(values)[:, None, None])
        starts = [0]
        for count in BLOCKS[name]:
            starts.append(starts[-1] + 2 * count + 1)
        # Up to the first ReLU of each block; what follows the last of them is never run.
        ends = [start + 2 for start in starts[:5]]
        self.slices = list(zip([0, *ends[:-1]], ends, strict=True))

    def maps(self, images: Tensor) -> list[Tensor]:
        """(b, 3, h, w) in [-1, 1] -> the five compared feature maps."""
        x = (images * 0.5 + 0.5 - self.mean) / self.deviation
        maps = []
        for start, end in self.slices:
            x = self.features[start:end](x)
            maps.append(x)
        return maps

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Distance (b,) of images (b, 3, h, w) in [-1, 1] to targets, which get no gradient."""
        with torch.no_grad():
            targets = self.maps(b)
        distances = [
            rate * (x - y).abs().float().mean((1, 2, 3))
            for rate, x, y in zip(WEIGHTS, self.maps(a), targets, strict=True)
        ]
        return torch.stack(distances).sum(0)
