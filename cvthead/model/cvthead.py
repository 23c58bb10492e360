"""The open preset of CVTHead: source -> descriptors (once), descriptors -> frame (each)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cvthead.head.hierarchy import MeshHierarchy
from cvthead.model.config import ModelConfig
from cvthead.model.fill import fill
from cvthead.model.light_unet import LightUNet
from cvthead.model.pixel_aligned import PixelAlignedFusion
from cvthead.model.positional import image_code, vertex_code
from cvthead.model.pyramid_encoder import PyramidEncoder
from cvthead.model.spiral import SpiralUpsampler
from cvthead.model.splat import splat
from cvthead.model.transformer import Transformer
from cvthead.points import PointLayout
from cvthead.runtime.fill import FILL_LEVELS
from cvthead.runtime.splat import EMPTY_DEPTH


class CVTHead(nn.Module):
    """Vertex-feature transformer and neural point renderer (paper section 3).

    :meth:`describe` depends on the source only, :meth:`paint` on the driven points only: the
    caller keeps the descriptors and pays :meth:`paint` per frame.
    """

    coarse: Tensor  # (coarse vertices,) their numbers on the full mesh
    edges: Tensor  # (midpoints, 2)
    mirror: Tensor  # (vertices + midpoints,)
    image_code: Tensor  # (tokens, token_size)

    def __init__(self, config: ModelConfig, hierarchy: MeshHierarchy, layout: PointLayout) -> None:
        super().__init__()
        self.config = config
        size = config.token_size
        coarse = torch.from_numpy(hierarchy.coarse).long()
        for name, value in {
            "coarse": coarse,
            "edges": torch.from_numpy(layout.edges).long(),
            "mirror": torch.from_numpy(layout.mirror).long(),
            "image_code": image_code(config.token_grid, size),
        }.items():
            self.register_buffer(name, value, persistent=False)
        self.encoder = PyramidEncoder(size, config.pixel_aligned_size)
        self.vertex_query = nn.Parameter(torch.randn(len(coarse), size) * 0.02)
        self.transformer = Transformer(size, config.depth, config.heads, config.mlp_size)
        self.upsampler = SpiralUpsampler(hierarchy, size, config.upsampler_sizes)
        self.fusion = PixelAlignedFusion(
            layout.vertices,
            config.upsampler_sizes[-1],
            config.pixel_aligned_size,
            config.point_embedding_size,
            config.descriptor_size,
        )
        # Depth, descriptor, seen and the coverage of each level.
        size_in = 1 + config.descriptor_size + 1 + FILL_LEVELS
        self.unet = LightUNet(size_in, config.unet_sizes, config.unet_unshuffle)

    def describe(
        self, source: Tensor, points: Tensor, clear: Tensor, anchor: Tensor, hidden: Tensor
    ) -> Tensor:
        """Point descriptors of a source image (paper section 3.3).

        Args:
            source: (b, 4, 256, 256), RGB in [-1, 1] with 0 outside the person, and the mask.
            points: (b, p, 3) normalised source projections: vertices, midpoints, shell.
            clear: (b, p) 1 where the source shows the point, see cvthead.clear.clear_points.
            anchor: (b, shell) vertex that each shell point hangs on.
            hidden: (b, p, 3) of cvthead.hidden; not used by the transformer alone.

        Returns:
            (b, p, C) float32.
        """
        tokens, pixels = self.encoder(source)
        lent: Tensor | None = hidden
        if self.config.features == "pixel-aligned":
            size = self.config.upsampler_sizes[-1]
            vertex = points.new_zeros(len(points), self.fusion.vertex_embedding.shape[0], size)
        else:
            query = self.vertex_query + vertex_code(points[:, self.coarse], self.config.token_size)
            x = torch.cat([query, tokens.float() + self.image_code], dim=1)
            x = self.transformer(x)[:, : len(self.coarse)]
            vertex = self.upsampler(x)  # b n f
            if self.config.features == "transformer":
                clear, lent = torch.zeros_like(clear), None
        embedding = self.fusion.vertex_embedding.expand(len(source), -1, -1)
        feature = self._spread(vertex, anchor)
        embedding = self._spread(embedding, anchor)
        embedding[:, -anchor.shape[1] :] += self.fusion.shell_embedding
        shell = torch.arange(len(self.mirror), points.shape[1], device=self.mirror.device)
        mirror = torch.cat([self.mirror, shell])
        out: Tensor = self.fusion(
            feature, embedding, pixels.float(), source, points, clear, mirror, lent
        )
        return out

    def _spread(self, vertex: Tensor, anchor: Tensor) -> Tensor:
        """(b, n, c) vertex values -> (b, p, c) at vertices, edge midpoints and shell points."""
        middle = (vertex[:, self.edges[:, 0]] + vertex[:, self.edges[:, 1]]) / 2
        shell = vertex.gather(1, anchor[..., None].expand(-1, -1, vertex.shape[-1]))
        return torch.cat([vertex, middle, shell], dim=1)

    def paint(
        self, points: Tensor, descriptors: Tensor, seen: Tensor, warped: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Neural vertex rendering (paper section 3.4).

        Args:
            points: (b, p, 3) normalised driven projections, see cvthead.runtime.face.splatted.
            descriptors: (b, p, C) from :meth:`describe`.
            seen: (b, p) how the portrait sees each point, see cvthead.source.places.
            warped: (b, 4, size, size), the source as given to :meth:`describe`, carried to the
                driven points (cvthead.runtime.place); size is a multiple of 32.

        Returns:
            RGB (b, 3, size, size) in [-1, 1] and mask logits (b, 1, size, size).
        """
        carry = self.config.features != "transformer"
        if not carry:
            seen = torch.zeros_like(seen)
        values = torch.cat([descriptors, seen[..., None]], dim=-1)
        image = splat(points, values, warped.shape[-1] // self.config.unet_unshuffle)
        with torch.autocast(image.device.type, enabled=False):
            filled = self.filled(image)
        out: tuple[Tensor, Tensor] = self.unet(filled, warped, carry=carry)
        return out

    def filled(self, image: Tensor) -> Tensor:
        """Depth, descriptor and seen (b, 1 + C + 1, s, s) with holes -> the U-Net's input."""
        covered = (image[:, :1] > EMPTY_DEPTH).float()
        dense, coverage = fill(image[:, :-1], covered, FILL_LEVELS)
        return torch.cat([dense, image[:, -1:], *coverage], dim=1)
