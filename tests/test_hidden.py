"""Colours of what the portrait hides."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.clear import FEWEST, clear_points
from cvthead.head.model import HeadModel, Region
from cvthead.hidden import hidden_colours
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
    one = np.flatnonzero(layout.mirror > np.arange(layout.surface))
    points[layout.mirror[one]] = points[one] * np.array([-1, 1, 1], np.float32)
    return points


def test_a_hidden_point_takes_the_colour_beside_it(
    layout: PointLayout, source: Array, points: Array
) -> None:
    clear = np.random.default_rng(1).random(layout.total) < 0.3
    found = hidden_colours(layout, source, points, clear)
    assert not found[clear].any()
    known = clear.copy()
    known[: layout.surface] |= clear[layout.mirror]
    # Of smaller parts the nearest points shown may lie in the other half.
    large = np.zeros(layout.total, np.bool_)
    large[: layout.surface] = layout.region == Region.FACE
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
    clear = np.zeros(layout.total, np.bool_)
    clear[scalp[50:]] = clear[face] = True
    hidden = scalp[:50][~clear[layout.mirror[scalp[:50]]]]
    assert len(hidden)
    assert np.allclose(hidden_colours(layout, source, points, clear)[hidden], LEFT, atol=1e-5)


def test_the_rim_of_the_person_lends_no_colour(layout: PointLayout) -> None:
    size = 64
    source = np.zeros((4, size, size), np.float32)
    source[:, 16:48, 16:48] = 1
    source[:3, 18:46, 18:46] = -0.5
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.48, 0.48, (layout.total, 3)).astype(np.float32)
    visible = rng.random(layout.total) < 0.3
    clear = clear_points(layout, source, points, visible)
    assert 0 < clear.sum() < visible.sum()
    found = hidden_colours(layout, source, points, clear)
    assert (found != 0).any()
    assert np.allclose(found[(found != 0).any(1)], -0.5, atol=1e-5)


def test_nearer_points_weigh_more(layout: PointLayout, source: Array) -> None:
    points = np.full((layout.total, 3), 5, np.float32)
    clear = np.zeros(layout.total, np.bool_)
    shell = np.arange(layout.surface, layout.surface + 3)  # they have no counterpart
    points[shell] = [(-0.3, 0, 0), (0.9, 0, 0), (0, 0, 0)]
    clear[shell[:2]] = True
    found = hidden_colours(layout, source, points, clear)[shell[2]]
    near, far = (np.array(each) for each in (LEFT, RIGHT))
    share = float((found - far) @ (near - far) / np.square(near - far).sum())
    assert share == pytest.approx(0.91**2 / (0.91**2 + 0.31**2), abs=1e-4)


def test_what_is_seen_across_the_face_comes_in_this_sides_light(
    layout: PointLayout, points: Array
) -> None:
    light, dark, mole = (np.array(each, np.float32) for each in ((0.5,) * 3, (0.1,) * 3, (0, 0, 0)))
    image = np.ones((4, 64, 64), np.float32)
    image[:3, :, :32], image[:3, :, 32:] = dark[:, None, None], light[:, None, None]
    image[:3, 30:34, 46:50] = mole[:, None, None]
    points = points.copy()
    points[np.abs(points[:, 1]) < 0.2, 1] += 0.4  # the mole is of one point alone
    hidden = np.flatnonzero(layout.region == Region.FACE)[:1]
    across = layout.mirror[hidden]
    points[hidden], points[across] = (-0.5, 0, 0), (0.5, 0, 0)
    clear = np.ones(layout.total, np.bool_)
    clear[hidden] = False
    found = hidden_colours(layout, image, points, clear)[hidden]
    assert np.allclose(found, (dark + (mole + dark - light)) / 2, atol=0.02)
    assert not np.allclose(found, (dark + mole) / 2, atol=0.1)


@pytest.mark.parametrize(("distance", "colour"), [(0.01, "shirt"), (0.5, "skin")])
def test_clothes_end_where_the_portrait_no_longer_shows_them(
    distance: float, colour: str, layout: PointLayout
) -> None:
    colours = {"skin": (0.4, 0.0, -0.2), "shirt": (-1.0, -0.8, 0.6)}
    image = np.ones((4, 64, 64), np.float32)
    image[:3, :, :32] = np.array(colours["shirt"], np.float32)[:, None, None]
    image[:3, :, 32:] = np.array(colours["skin"], np.float32)[:, None, None]
    points = np.zeros((layout.total, 3), np.float32)
    points[:, 0] = 0.6
    neck = np.flatnonzero((layout.region == Region.NECK) & (layout.mirror != 0))
    points[neck[: len(neck) // 2], 0] = -0.5
    hidden = neck[:1]
    points[hidden, 2] = distance
    clear = np.ones(layout.total, np.bool_)
    clear[hidden] = clear[layout.mirror[hidden]] = False
    found = hidden_colours(layout, image, points, clear)[hidden]
    assert np.allclose(found, colours[colour], atol=0.05)


@pytest.mark.parametrize("shown", [0, 1, FEWEST - 1])
def test_few_visible_points_are_enough(
    shown: int, layout: PointLayout, source: Array, points: Array
) -> None:
    clear = np.zeros(layout.total, np.bool_)
    clear[layout.surface : layout.surface + shown] = True
    found = hidden_colours(layout, source, points, clear)
    assert np.isfinite(found).all()
    assert found.any() == (shown > 0)
    # The same of the face, whose points have counterparts.
    clear = np.zeros(layout.total, np.bool_)
    clear[np.flatnonzero(layout.region == Region.FACE)[:shown]] = True
    found = hidden_colours(layout, source, points, clear)
    assert np.isfinite(found).all()
    assert (np.abs(found) <= 1).all()
    assert found.any() == (shown > 0)


def test_every_point_seen_leaves_nothing_to_guess(
    layout: PointLayout, source: Array, points: Array
) -> None:
    clear = np.ones(layout.total, np.bool_)
    assert not hidden_colours(layout, source, points, clear).any()
