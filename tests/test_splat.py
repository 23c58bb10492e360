"""Invariants of the z-buffered splat."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cvthead.model.splat import (
    clamped_pixel_index,
    nearest_points,
    pixel_index,
    splat,
    splat_clamped,
)
from cvthead.runtime.splat import BLOCK, EMPTY_DEPTH, FRONT

SIZE = 16
Splat = Callable[[Tensor, Tensor, int], Tensor]
both = pytest.mark.parametrize("draw", [splat, splat_clamped])


def cloud(batch: int, points: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Crowded points of one surface, some outside the frame, every depth different."""
    random = torch.Generator().manual_seed(seed)
    projected = torch.rand(batch, points, 3, generator=random) * 2.6 - 1.3
    projected[..., 2] = torch.stack(
        [torch.randperm(points, generator=random) / points for _ in range(batch)]
    )
    projected[..., 2] *= FRONT
    return projected, torch.randn(batch, points, 5, generator=random)


def at(*points: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    """One image with the given points; descriptor = 1, 2, 3... in their order."""
    return torch.tensor([points]), torch.arange(1.0, len(points) + 1)[None, :, None]


@both
def test_nearer_point_wins(draw: Splat) -> None:
    for points in ([(0.1, 0.1, 0.5), (0.1, 0.1, -0.5)], [(0.1, 0.1, -0.5), (0.1, 0.1, 0.5)]):
        projected, descriptors = at(*points)
        image = draw(projected, descriptors, SIZE)[0]
        painted = image[:, image[0] != EMPTY_DEPTH]
        nearer = 1 + min(range(2), key=lambda i: points[i][2])
        assert painted.tolist() == [[-0.5], [nearer]]


@both
def test_at_equal_depth_the_higher_number_wins(draw: Splat) -> None:
    image = draw(*at((0.1, 0.1, 0.0), (0.1, 0.1, 0.0), (0.1, 0.1, 0.0)), SIZE)[0]
    assert image[1].max() == 3


@both
def test_order_of_points_is_irrelevant(draw: Splat) -> None:
    projected, descriptors = cloud(2, 400)
    shuffle = torch.randperm(400, generator=torch.Generator().manual_seed(1))
    expected = draw(projected, descriptors, SIZE)
    assert torch.equal(draw(projected[:, shuffle], descriptors[:, shuffle], SIZE), expected)


@both
def test_every_pixel_holds_the_nearest_of_its_points(draw: Splat) -> None:
    index_of = pixel_index if draw is splat else clamped_pixel_index
    projected, descriptors = cloud(1, 400)
    image = draw(projected, descriptors, SIZE)[0].flatten(1)
    index = index_of(projected, SIZE)[0]
    empty = 0
    for pixel in range(SIZE * SIZE):
        candidates = (index == pixel).nonzero()[:, 0]
        if len(candidates):
            nearest = candidates[projected[0, candidates, 2].argmin()]
            assert image[0, pixel] == projected[0, nearest, 2]
            assert torch.equal(image[1:, pixel], descriptors[0, nearest])
        else:
            empty += 1
            assert image[:, pixel].tolist() == [EMPTY_DEPTH, 0, 0, 0, 0, 0]
    assert 0 < empty < SIZE * SIZE


@both
def test_batch_equals_loop(draw: Splat) -> None:
    projected, descriptors = cloud(3, 200)
    each = [draw(projected[i : i + 1], descriptors[i : i + 1], SIZE) for i in range(3)]
    assert torch.equal(draw(projected, descriptors, SIZE), torch.cat(each))


@both
def test_memory_layout_is_irrelevant(draw: Splat) -> None:
    projected, descriptors = cloud(2, 200)
    strided = projected.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    assert not strided.is_contiguous()
    expected = draw(projected, descriptors, SIZE)
    assert torch.equal(draw(strided, descriptors, SIZE), expected)


@both
def test_gradient_reaches_exactly_the_painted_descriptors(draw: Splat) -> None:
    projected, descriptors = cloud(2, 400)
    index_of = pixel_index if draw is splat else clamped_pixel_index
    owner = nearest_points(index_of(projected, SIZE), projected[..., 2], SIZE)
    descriptors.requires_grad_()
    total = draw(projected, descriptors, SIZE)[:, 1:].sum()
    (gradients,) = torch.autograd.grad(total, descriptors)
    for gradient, owners in zip(gradients, owner, strict=True):
        expected = torch.zeros(400)
        expected[owners[owners >= 0]] = 1
        assert torch.equal(gradient, expected[:, None].expand(-1, 5))


def test_the_back_does_not_shine_through_the_front() -> None:
    x = (BLOCK + 0.5) * 2 / SIZE - 1
    neighbour = x + 2 / SIZE  # another pixel of the same block
    hidden = splat(*at((x, x, 0.0), (neighbour, x, FRONT * 1.01)), SIZE)[0, 1]
    assert hidden[hidden != 0].tolist() == [1]
    same_surface = splat(*at((x, x, 0.0), (neighbour, x, FRONT * 0.99)), SIZE)[0, 1]
    assert sorted(same_surface[same_surface != 0].tolist()) == [1, 2]
    other_block = splat(*at((x, x, 0.0), (x + BLOCK * 2 / SIZE, x, 1.0)), SIZE)[0, 1]
    assert sorted(other_block[other_block != 0].tolist()) == [1, 2]


def test_points_outside_are_dropped_by_the_open_preset() -> None:
    outside = [(-1.01, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -3.0, 0.0), (0.0, 1.0, 0.0)]
    image = splat(*at(*outside), SIZE)
    assert (image[:, 0] == EMPTY_DEPTH).all()


def test_points_outside_are_clamped_by_the_paper_preset() -> None:
    outside = [(-9.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, -9.0, 0.0), (0.0, 9.0, 0.0)]
    image = splat_clamped(*at(*outside), SIZE)[0, 1]
    middle, last = SIZE // 2, SIZE - 1
    assert image[middle, [0, last]].tolist() == [1, 2]
    assert image[[0, last], middle].tolist() == [3, 4]


def test_open_preset_floors_and_paper_preset_rounds_half_to_even() -> None:
    def column(x: float) -> Tensor:
        return torch.tensor([[[x / (SIZE / 2) - 1, -1.0, 0.0]]])

    xs = [2.25, 2.5, 2.75, 3.5]
    assert [int(pixel_index(column(x), SIZE)) for x in xs] == [2, 2, 2, 3]
    assert [int(clamped_pixel_index(column(x), SIZE)) for x in xs] == [2, 2, 3, 4]
