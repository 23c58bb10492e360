"""The portrait's own pixels, carried to where the driven points are.

A descriptor per point cannot hold every hair and pore. But each point knows where the portrait
shows it, so the splat also carries a flow from the driven frame back to the portrait; read
through it, the portrait gives the U-Net a sharp first guess of everything the source saw.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from cvthead.model.fill import fill, smooth
from cvthead.runtime.warp import FLOW_LEVELS


def pixel_centres(size: int, like: Tensor) -> Tensor:
    """(1, 2, size, size) normalised x and y of the pixel centres."""
    line = (torch.arange(size, device=like.device, dtype=torch.float32) + 0.5) * (2 / size) - 1
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y])[None]


def dense_flow(flow: Tensor, known: Tensor, size: int) -> Tensor:
    """Splatted flow (b, 2, h, w), valid where known (b, 1, h, w) is 1 -> (b, 2, size, size)."""
    even = smooth(flow, known)
    dense, _ = fill(even, (F.max_pool2d(known, 3, 1, 1) > 0).to(flow.dtype), FLOW_LEVELS)
    return F.interpolate(dense, (size, size), mode="bilinear", align_corners=False)


def warp(portrait: Tensor, flow: Tensor) -> Tensor:
    """Portrait (b, c, s, s) read at pixel centre + flow (b, 2, size, size), bilinear."""
    grid = (pixel_centres(flow.shape[-1], flow) + flow).permute(0, 2, 3, 1)
    return F.grid_sample(portrait, grid, "bilinear", "border", align_corners=False)
