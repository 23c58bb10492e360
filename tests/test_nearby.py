"""Colours of what the portrait hides."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.head.model import HeadModel, Region
from cvthead.nearby import NEAREST, nearby_colours
from cvthead.points import PointLayout

Array = NDArray[np.float32]

LEFT, RIGHT = (0.5, -1.0, -1.0), (-1.0, 0.2, 1.0)


@pytest.fixture(scope="module")
def layout() -> PointLayout:
    return PointLayout.of(HeadModel.load())


@pytest.fixture(scope="module")
def source() -> Array:
    """One colour on either half."""
    image = np.ones((4, 64, 64), np.float32)
    image[:3, :, :32] = np.array(LEFT, np.float32)[:, None, None]
    image[:3, :, 32:] = np.array(RIGHT, np.float32)[:, None, None]
    return image


@pytest.fixture(scope="module")
def points(layout: PointLayout) -> Array:
    """A cloud on either half, each point's mirrored counterpart in the other."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.9, 0.9, (layout.total, 3)).astype(np.float32)
    points[:, 0] = 0.5 + points[:, 0] / 3
    points[rng.random(len(points)) < 0.5, 0] *= -1
    return points


def test_a_hidden_point_takes_the_colour_beside_it(
    layout: PointLayout, source: Array, points: Array
) -> None:
    visible = np.random.default_rng(1).random(layout.total) < 0.3
    found = nearby_colours(layout, source, points, visible)
    known = visible.copy()
    known[: layout.surface] |= visible[layout.mirror]
    assert not found[known].any()
    # Of smaller parts the nearest points shown may lie in the other half.
    large = np.zeros(layout.total, np.bool_)
    large[: layout.surface] = np.isin(layout.region, [Region.FACE, Region.SCALP])
    left = large & ~known & (points[:, 0] < 0)
    right = large & ~known & (points[:, 0] > 0)
    assert left.sum() > 1000
    assert right.sum() > 1000
    assert np.allclose(found[left], LEFT, atol=1e-5)
    assert np.allclose(found[right], RIGHT, atol=1e-5)


def test_hair_takes_no_colour_from_skin(layout: PointLayout, source: Array) -> None:
    scalp, face = (np.flatnonzero(layout.region == kind) for kind in (Region.SCALP, Region.FACE))
    points = np.zeros((layout.total, 3), np.float32)
    points[scalp] = (-0.5, 0, 0)
    points[face] = (0.5, 0, 0)
    # Hidden hair beside the face, far from what is seen of the hair.
    points[scalp[:50]] = (0.5, 0, 0.1)
    visible = np.zeros(layout.total, np.bool_)
    visible[scalp[50:]] = visible[face] = True
    hidden = scalp[:50][~visible[layout.mirror[scalp[:50]]]]
    assert len(hidden)
    assert np.allclose(nearby_colours(layout, source, points, visible)[hidden], LEFT, atol=1e-5)


def test_the_rim_of_the_person_lends_no_colour(layout: PointLayout) -> None:
    size = 64
    source = np.zeros((4, size, size), np.float32)
    source[:, 16:48, 16:48] = 1
    source[:3, 18:46, 18:46] = -0.5
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.48, 0.48, (layout.total, 3)).astype(np.float32)
    visible = rng.random(layout.total) < 0.3
    found = nearby_colours(layout, source, points, visible)
    assert (found != 0).any()
    assert np.allclose(found[(found != 0).any(1)], -0.5, atol=1e-5)


def test_nearer_points_weigh_more(layout: PointLayout, source: Array) -> None:
    points = np.full((layout.total, 3), 5, np.float32)
    visible = np.zeros(layout.total, np.bool_)
    shell = np.arange(layout.surface, layout.surface + 3)  # they have no counterpart
    points[shell] = [(-0.3, 0, 0), (0.9, 0, 0), (0, 0, 0)]
    visible[shell[:2]] = True
    found = nearby_colours(layout, source, points, visible)[shell[2]]
    near, far = (np.array(each) for each in (LEFT, RIGHT))
    share = float((found - far) @ (near - far) / np.square(near - far).sum())
    assert share == pytest.approx(0.91 / (0.91 + 0.31), abs=1e-4)


@pytest.mark.parametrize("shown", [0, 1, NEAREST - 1])
def test_few_visible_points_are_enough(
    shown: int, layout: PointLayout, source: Array, points: Array
) -> None:
    visible = np.zeros(layout.total, np.bool_)
    visible[layout.surface : layout.surface + shown] = True
    found = nearby_colours(layout, source, points, visible)
    assert np.isfinite(found).all()
    assert found.any() == (shown > 0)


def test_every_point_seen_leaves_nothing_to_guess(
    layout: PointLayout, source: Array, points: Array
) -> None:
    visible = np.ones(layout.total, np.bool_)
    assert not nearby_colours(layout, source, points, visible).any()
