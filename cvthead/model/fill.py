"""Holes of a splat, filled from its neighbours at coarser and coarser scales (pull-push)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from cvthead.runtime.warp import EPSILON


def fill(values: Tensor, weight: Tensor, levels: int) -> tuple[Tensor, list[Tensor]]:
    """Known values stay; a hole takes the average of what its 2, 4, ... pixel block knows.

    Args:
        values: (b, c, h, w); h and w are multiples of 2 ** levels.
        weight: (b, 1, h, w), 1 where values are known, 0 in holes.
        levels: halvings; blocks of 2 ** levels pixels that know nothing stay 0.

    Returns:
        Filled (b, c, h, w), and the coverage of each level's blocks (b, 1, h, w), 0..1.
    """
    pulled = [(values * weight, weight)]
    for _ in range(levels):
        pulled.append((F.avg_pool2d(pulled[-1][0], 2), F.avg_pool2d(pulled[-1][1], 2)))
    total, share = pulled[-1]
    out = total / share.clamp(min=EPSILON)
    for total, share in reversed(pulled[:-1]):
        coarse = F.interpolate(out, scale_factor=2.0, mode="bilinear", align_corners=False)
        out = torch.where(share > 0, total / share.clamp(min=EPSILON), coarse)
    covered = [
        F.interpolate(share, values.shape[-2:], mode="bilinear", align_corners=False)
        for _, share in pulled[1:]
    ]
    return out, covered


def smooth(values: Tensor, weight: Tensor) -> Tensor:
    """Average of the known values among each pixel and its eight neighbours."""
    total = F.avg_pool2d(values * weight, 3, stride=1, padding=1)
    share = F.avg_pool2d(weight, 3, stride=1, padding=1)
    return total / share.clamp(min=EPSILON)
