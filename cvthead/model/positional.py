"""Sine codes of image tokens, vertex projections and depth (paper section 3.3)."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def sine_code(angle: Tensor, size: int) -> Tensor:
    """(...) angles in radians -> (..., size), sine and cosine interleaved."""
    k = torch.arange(size, device=angle.device)
    period = 10000.0 ** (2 * torch.div(k, 2, rounding_mode="floor") / size)
    phase = angle[..., None] / period
    return torch.where(k % 2 == 0, phase.sin(), phase.cos())


def image_code(grid: int, size: int) -> Tensor:
    """(grid * grid, size) codes of the image tokens, row-major; y half first."""
    position = (torch.arange(grid) + 1) / (grid + 1e-6) * 2 * math.pi
    code = sine_code(position, size // 2)  # grid, size/2
    y = code[:, None].expand(-1, grid, -1)
    x = code[None].expand(grid, -1, -1)
    return torch.cat([y, x], dim=-1).reshape(grid * grid, size)


def vertex_code(projected: Tensor, size: int) -> Tensor:
    """(..., 3) normalised projections (x, y in [-1, 1], depth) -> (..., size); E_uv + E_dep."""
    angle = (0.5 * projected + 0.5) * 2 * math.pi
    u, v, depth = angle.unbind(-1)
    uv = torch.cat([sine_code(v, size // 2), sine_code(u, size // 2)], dim=-1)
    return uv + sine_code(depth, size)
