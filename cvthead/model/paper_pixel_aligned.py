"""The paper's ablation on vertex features: pixel-aligned ones instead of the transformer's."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cvthead.model.config import PAPER, ModelConfig
from cvthead.model.pixel_aligned import sample
from cvthead.model.splat import splat_clamped
from cvthead.model.unet import UNet


class PixelAlignedCVTHead(nn.Module):
    """A U-Net's features at each vertex's projection, hidden or not (paper section 4.4, after
    S3F), painted as :class:`cvthead.model.paper.PaperCVTHead` paints."""

    def __init__(self, config: ModelConfig = PAPER) -> None:
        super().__init__()
        self.config = config
        self.extractor = UNet(4, config.unet_sizes, config.descriptor_size)
        self.unet = UNet(1 + config.descriptor_size, config.unet_sizes)

    def describe(self, source: Tensor, projected: Tensor) -> Tensor:
        """(b, 4, 256, 256) and (b, n, 3) -> (b, n, C); as PaperCVTHead.describe."""
        return sample(self.extractor(source), projected)

    def paint(self, projected: Tensor, descriptors: Tensor, size: int) -> tuple[Tensor, Tensor]:
        """As PaperCVTHead.paint."""
        out = self.unet(splat_clamped(projected, descriptors, size))
        return torch.tanh(out[:, :3]), out[:, 3:]
