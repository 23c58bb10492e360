"""Pixel-aligned branch of the open preset, fused with the transformer's vertex features.

The paper argues (section 3.3) that features sampled at a vertex's projection are sharp where
the vertex is visible and wrong where it is not. So they are gated by visibility; hidden points
see their mirrored counterpart when that is visible, and the transformer's feature always. Their
colour is lent by points that are visible (cvthead/hidden.py).
The first three descriptor channels are the point's colour in [-1, 1].
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

COLOUR_SIZE = 3


def sample(image: Tensor, points: Tensor) -> Tensor:
    """(b, c, h, w) at normalised (b, p, 2+) -> (b, p, c), bilinear."""
    grid = points[:, :, None, :2]
    out = F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return out[..., 0].transpose(1, 2)


class PixelAlignedFusion(nn.Module):
    """[vertex feature, gated pixel features, gated colours, embedding] -> descriptor."""

    def __init__(
        self, vertices: int, vertex_size: int, pixel_size: int, embedding_size: int, size: int
    ) -> None:
        super().__init__()
        self.vertex_embedding = nn.Parameter(torch.randn(vertices, embedding_size) * 0.02)
        self.shell_embedding = nn.Parameter(torch.zeros(embedding_size))
        size_in = vertex_size + pixel_size + 2 * COLOUR_SIZE + 2 + embedding_size
        self.head = nn.Sequential(nn.Linear(size_in, 96), nn.GELU(), nn.Linear(96, size))

    def forward(
        self,
        features: Tensor,
        embedding: Tensor,
        pixels: Tensor,
        source: Tensor,
        points: Tensor,
        clear: Tensor,
        mirror: Tensor,
        hidden: Tensor | None,
    ) -> Tensor:
        """Descriptors of all points.

        Args:
            features: (b, p, vertex_size) transformer features at the points.
            embedding: (b, p, embedding_size).
            pixels: (b, pixel_size, 128, 128) from the encoder.
            source: (b, 4, 256, 256).
            points: (b, p, 3) source projections.
            clear: (b, p) 1 where the source shows the point clear of the outline, else 0.
            mirror: (p,) the point's mirrored counterpart.
            hidden: (b, p, 3) colour of the others, see cvthead.hidden; None lets the network
                guess it.

        Returns:
            (b, p, size): colour, then learned channels.
        """
        own = clear[..., None]
        other = own[:, mirror] * (1 - own)
        colour = sample(source[:, :COLOUR_SIZE], points) * own
        lent = torch.zeros_like(colour) if hidden is None else hidden * (1 - own)
        aligned = sample(pixels, points) * own
        aligned = aligned + aligned[:, mirror] * other
        inputs = [features, aligned, colour, lent, own, other, embedding]
        out = self.head(torch.cat([x.float() for x in inputs], dim=-1))
        # Not a guess on top of the lent colour: that learnt to mark hidden points with green. (The
        # layer's first three rows serve the transformer alone, which is told of no colour.)
        if hidden is None:
            lent = torch.tanh(out[..., :COLOUR_SIZE].float()) * (1 - own)
        painted = colour + lent
        learned = out[..., COLOUR_SIZE:].float()
        return torch.cat([painted, learned], dim=-1)
