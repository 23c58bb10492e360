"""The paper preset of CVTHead, computing what the released code computes.

Where paper and released code differ (rounding of pixels, points outside the frame) it follows
the code, since weights exist for that.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cvthead.head.hierarchy import MeshHierarchy
from cvthead.model.config import PAPER, ModelConfig
from cvthead.model.positional import image_code, vertex_code
from cvthead.model.rome_encoder import RomeEncoder
from cvthead.model.spiral import SpiralUpsampler
from cvthead.model.splat import splat_clamped
from cvthead.model.transformer import Transformer
from cvthead.model.unet import UNet


class PaperCVTHead(nn.Module):
    """Vertex-feature transformer and neural vertex renderer (paper section 3).

    :meth:`describe` depends on the source only, :meth:`paint` on the driven vertices only.
    """

    coarse: Tensor  # (coarse vertices,) their numbers on the full mesh
    image_code: Tensor  # (tokens, token_size), stored with the weights as in the released code

    def __init__(self, hierarchy: MeshHierarchy, config: ModelConfig = PAPER) -> None:
        super().__init__()
        self.config = config
        size = config.token_size
        coarse = torch.from_numpy(hierarchy.coarse).long()
        self.register_buffer("coarse", coarse, persistent=False)
        self.register_buffer("image_code", image_code(config.token_grid, size))
        self.encoder = RomeEncoder(size)
        self.vertex_query = nn.Parameter(torch.zeros(len(coarse), size))
        self.transformer = Transformer(size, config.depth, config.heads, config.mlp_size)
        self.upsampler = SpiralUpsampler(hierarchy, size, config.upsampler_sizes)
        self.to_descriptor = nn.Linear(config.upsampler_sizes[-1], config.descriptor_size)
        self.unet = UNet(1 + config.descriptor_size, config.unet_sizes)

    def describe(self, source: Tensor, projected: Tensor) -> Tensor:
        """Vertex descriptors of a source image (paper section 3.3).

        Args:
            source: (b, 4, 256, 256), RGB in [-1, 1] over its own background, and the mask.
            projected: (b, n, 3) source vertices in normalised image coordinates, y down, and
                depth, smaller is nearer.

        Returns:
            (b, n, C).
        """
        codes = vertex_code(projected[:, self.coarse], self.config.token_size)
        tokens = self.encoder(source) + self.image_code
        x = self.transformer(torch.cat([self.vertex_query + codes, tokens], dim=1))
        descriptors: Tensor = self.to_descriptor(self.upsampler(x[:, : len(self.coarse)]))
        return descriptors

    def paint(self, projected: Tensor, descriptors: Tensor, size: int) -> tuple[Tensor, Tensor]:
        """Neural vertex rendering (paper section 3.4).

        Args:
            projected: (b, n, 3) driven vertices, as in :meth:`describe`.
            descriptors: (b, n, C).
            size: output height and width, a multiple of 16; 256 in the released code.

        Returns:
            RGB (b, 3, size, size) in [-1, 1] and mask logits (b, 1, size, size).
        """
        out = self.unet(splat_clamped(projected, descriptors, size))
        return torch.tanh(out[:, :3]), out[:, 3:]
