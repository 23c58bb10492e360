"""Holes inside the person are closed where points lie, and left where the background shows."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.runtime.holes import without_holes

Codes = NDArray[np.uint8]

SIZE = 64
ALL = np.full((SIZE, SIZE), 255, np.uint8)


@pytest.fixture
def person() -> Codes:
    """A disc with a soft edge, and a hole with a soft edge in it."""
    alpha = np.zeros((SIZE, SIZE), np.uint8)
    cv2.circle(alpha, (32, 32), 24, 255, -1)
    cv2.circle(alpha, (38, 30), 4, 0, -1)
    return np.asarray(cv2.GaussianBlur(alpha, (0, 0), 1), np.uint8)


def test_a_hole_over_points_is_closed(person: Codes) -> None:
    closed = without_holes(person, ALL)
    assert person[30, 38] < 10
    assert (closed[20:44, 20:44] > 200).all()
    # Nothing else changes.
    beside = cv2.circle(np.zeros_like(person), (38, 30), 10, 1, -1) == 0
    assert np.array_equal(closed[beside], person[beside])
    assert (closed >= person).all()


def test_alpha_stays_below_what_points_reach(person: Codes) -> None:
    reach = ALL.copy()
    reach[:, 44:] = 100  # beside the hole
    assert (without_holes(np.minimum(person, reach), reach) <= reach).all()
    assert without_holes(np.minimum(person, reach), reach)[30, 38] > 90


def test_a_hole_where_no_point_lies_stays(person: Codes) -> None:
    reach = ALL.copy()
    reach[29:32, 37:40] = 0
    assert np.array_equal(without_holes(person, reach), person)


def test_a_bay_of_the_background_stays(person: Codes) -> None:
    person[30, 38:] = 0
    assert np.array_equal(without_holes(person, ALL), person)


def test_a_hole_in_a_veil_is_filled_with_the_veil(person: Codes) -> None:
    """Or a pixel more or less at the threshold would make a solid spot."""
    veil = np.asarray(person * 0.55, np.uint8)
    closed = without_holes(veil, ALL)
    assert 100 < closed[30, 38] <= veil.max()
    assert closed.max() <= veil.max()


@pytest.mark.parametrize("alpha", [0, 255])
def test_nobody_and_all_person_stay(alpha: int) -> None:
    everywhere = np.full((SIZE, SIZE), alpha, np.uint8)
    assert np.array_equal(without_holes(everywhere, ALL), everywhere)
