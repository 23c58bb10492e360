"""Face identity loss: cosine distance of VGGFace2 embeddings (Cao et al. 2018)."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvthead.model.resnet import BottleneckBlock, ResNet
from cvthead.training.frozen import fill, load_state

SIZE = 224
# Of the VGGFace2 weights, which take blue, green, red in 0..255.
MEAN_BGR = (91.4953, 103.8827, 131.0912)


class VGGFace2ResNet50(ResNet):
    """ResNet-50 as VGGFace2's authors have it (from Caffe): the stride sits in each block's first
    convolution, and the first pool is not padded."""

    def __init__(self) -> None:
        super().__init__(BottleneckBlock, (3, 4, 6, 3))
        for number in (2, 3, 4):
            first = self.get_submodule(f"layer{number}.0")
            assert isinstance(first, BottleneckBlock)
            first.conv1.stride, first.conv2.stride = (2, 2), (1, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        x = F.relu(self.bn1(self.conv1(image)))
        x = F.max_pool2d(x, 3, 2, ceil_mode=True)
        maps = []
        for number in range(1, 5):
            x = self.get_submodule(f"layer{number}")(x)
            maps.append(x)
        return tuple(maps)


class IdentityDistance(nn.Module):
    """One minus the cosine of two views' embeddings.

    Args:
        path: state dict of a VGGFace2 ResNet-50 (resnet50_ft or resnet50_scratch, with the key
            names ``conv1.weight``, ``layer1.0.conv1.weight`` ...); its classifier is not needed.

    Raises:
        InputError: no such file, or not such a network.
    """

    mean: Tensor

    def __init__(self, path: Path) -> None:
        super().__init__()
        state = load_state(path, "VGGFace2 ResNet-50")
        self.network = VGGFace2ResNet50()
        kept = {key: value for key, value in state.items() if not key.startswith("fc.")}
        fill(self.network, kept, path, "VGGFace2 ResNet-50")
        self.register_buffer("mean", torch.tensor(MEAN_BGR)[:, None, None])

    def embedding(self, images: Tensor) -> Tensor:
        """(b, 3, h, w) RGB in [-1, 1] -> (b, 2048)."""
        x = F.interpolate(images, (SIZE, SIZE), mode="bilinear", align_corners=False)
        return self.network.pooled((x.flip(1) + 1) * 127.5 - self.mean).float()

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """(b,) distance of views (b, 3, h, w) to targets, which get no gradient."""
        with torch.no_grad():
            target = self.embedding(b)
        return 1 - F.cosine_similarity(self.embedding(a), target)
