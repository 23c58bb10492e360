"""Z-buffered splat of point descriptors into an image (paper section 3.4)."""

from __future__ import annotations

import torch
from torch import Tensor

from cvthead.runtime.splat import BLOCK, EMPTY_DEPTH, FRONT


def pixel_index(projected: Tensor, size: int) -> Tensor:
    """(b, p, 3) normalised projections -> (b, p) row-major pixel, ``size**2`` when outside.

    Floors, as in the paper's equation 4; points outside the frame are dropped.
    """
    pixel = torch.floor((projected[..., :2] * 0.5 + 0.5) * size).long()
    inside = ((pixel >= 0) & (pixel < size)).all(-1)
    return torch.where(inside, pixel[..., 1] * size + pixel[..., 0], size * size)


def clamped_pixel_index(projected: Tensor, size: int) -> Tensor:
    """(b, p, 3) normalised projections -> (b, p) row-major pixel, as the released code has it.

    Normalised 0 is the centre of pixel ``size / 2``: rounds to the nearest pixel, halves to the
    even one, after clamping points outside the frame onto its border.
    """
    pixel = (projected[..., :2] * (size / 2) + size / 2).clamp(0, size - 1).round().long()
    return pixel[..., 1] * size + pixel[..., 0]


def nearest_points(index: Tensor, depth: Tensor, size: int) -> Tensor:
    """The point that owns each pixel.

    Args:
        index: (b, p) row-major pixel of each point, ``size**2`` for points to drop.
        depth: (b, p); the smallest wins, and at equal depth the higher point number.
        size: image height and width.

    Returns:
        (b, size * size) point number, -1 where empty. Deterministic on every device.
    """
    points = index.shape[1]
    order = torch.argsort(depth, dim=1, descending=True, stable=True)
    rank = torch.empty_like(order)
    rank.scatter_(1, order, torch.arange(points, device=index.device).expand_as(order))
    winner = torch.full((len(index), size * size + 1), -1, dtype=torch.long, device=index.device)
    winner.scatter_reduce_(1, index, rank, "amax")
    winner = winner[:, : size * size]
    return torch.where(winner >= 0, order.gather(1, winner.clamp(min=0)), -1)


def paint(owner: Tensor, depth: Tensor, descriptors: Tensor, size: int) -> Tensor:
    """Depth and descriptors of the owning points as an image.

    Args:
        owner: (b, size * size) from :func:`nearest_points`.
        depth: (b, p).
        descriptors: (b, p, c).
        size: image height and width.

    Returns:
        (b, 1 + c, size, size): depth first (-2 where empty), then descriptors (0 where empty).
    """
    # A last, constant row answers for the empty pixels and saves a masking pass.
    rows = torch.cat([depth[..., None].to(descriptors.dtype), descriptors], dim=-1)
    blank = rows.new_zeros(len(rows), 1, rows.shape[-1])
    blank[..., 0] = EMPTY_DEPTH
    rows = torch.cat([rows, blank], dim=1)
    slot = torch.where(owner >= 0, owner, rows.shape[1] - 1)
    image = rows.gather(1, slot[..., None].expand(-1, -1, rows.shape[-1]))
    return image.transpose(1, 2).reshape(len(rows), -1, size, size)


def in_front(projected: Tensor, size: int) -> Tensor:
    """(b, p) whether each point lies at the front surface of its block of pixels.

    Points are sparse on the scalp; without this test the back of the head shines through.
    """
    blocks = size // BLOCK
    index = pixel_index(projected, blocks)
    depth = projected[..., 2]
    nearest = torch.full_like(depth[:, :1], torch.inf).repeat(1, blocks * blocks + 1)
    nearest.scatter_reduce_(1, index, depth, "amin")
    return depth <= nearest.gather(1, index) + FRONT


def splat(projected: Tensor, descriptors: Tensor, size: int) -> Tensor:
    """Splat of the open preset: (b, p, 3) and (b, p, c) -> (b, 1 + c, size, size)."""
    depth = projected[..., 2].contiguous()
    front = in_front(projected, size)
    index = torch.where(front, pixel_index(projected, size), size * size)
    return paint(nearest_points(index, depth, size), depth, descriptors, size)


def splat_clamped(projected: Tensor, descriptors: Tensor, size: int) -> Tensor:
    """Splat of the paper preset; shapes as in :func:`splat`."""
    depth = projected[..., 2].contiguous()
    owner = nearest_points(clamped_pixel_index(projected, size), depth, size)
    return paint(owner, depth, descriptors, size)
