"""Spiral convolutions that carry token features from the coarse mesh to every vertex."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvthead.head.hierarchy import MeshHierarchy


class SpiralConv(nn.Module):
    """Linear map of each vertex's spiral of neighbours (SpiralNet++)."""

    spiral: Tensor  # (vertices, length)

    def __init__(self, spiral: Tensor, size_in: int, size_out: int) -> None:
        super().__init__()
        self.register_buffer("spiral", spiral, persistent=False)
        self.linear = nn.Linear(spiral.shape[1] * size_in, size_out)

    def forward(self, x: Tensor) -> Tensor:
        vertices, length = self.spiral.shape
        neighbours = x.index_select(1, self.spiral.flatten())  # b (v l) c
        flat = neighbours.reshape(len(x), vertices, length * x.shape[-1])
        out: Tensor = self.linear(flat)
        return out


class Unpool(nn.Module):
    """Interpolates features of a coarse level at the vertices of the next finer one."""

    indices: Tensor  # (fine, 3)
    weights: Tensor  # (fine, 3)

    def __init__(self, indices: Tensor, weights: Tensor) -> None:
        super().__init__()
        self.register_buffer("indices", indices, persistent=False)
        self.register_buffer("weights", weights, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        corners = x.index_select(1, self.indices.flatten())  # b (v 3) c
        corners = corners.reshape(len(x), *self.indices.shape, x.shape[-1])
        return (corners * self.weights[..., None]).sum(2)


class SpiralUpsampler(nn.Module):
    """Unpool, convolve, ELU for each level; further convolutions without activation."""

    def __init__(self, hierarchy: MeshHierarchy, size_in: int, sizes: Sequence[int]) -> None:
        super().__init__()
        spirals = [torch.from_numpy(s).long() for s in hierarchy.spirals]
        ups = [(torch.from_numpy(i).long(), torch.from_numpy(w)) for i, w in hierarchy.up]
        levels = len(ups)  # hierarchy.up[k] leads from level k + 1 to level k
        self.unpools = nn.ModuleList(Unpool(*ups[k]) for k in reversed(range(levels)))
        self.convs = nn.ModuleList()
        for step, size in enumerate(sizes):
            level = max(levels - 1 - step, 0)
            self.convs.append(SpiralConv(spirals[level], size_in, size))
            size_in = size

    def forward(self, x: Tensor) -> Tensor:
        """(b, coarse, c) -> (b, vertices, sizes[-1])."""
        for step, conv in enumerate(self.convs):
            x = F.elu(conv(self.unpools[step](x))) if step < len(self.unpools) else conv(x)
        return x
