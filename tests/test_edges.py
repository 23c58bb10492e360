"""Colours at the person's edge and beyond."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead import Avatar, Pipeline
from cvthead.runtime import mix
from cvthead.runtime.edges import FAINT, SOLID, continued

RED, BLUE, GREEN = (200, 20, 30), (10, 40, 220), (0, 255, 0)


@pytest.fixture
def person() -> NDArray[np.uint8]:
    """A square, red on the left and blue on the right, with a soft green rim on a green ground."""
    image = np.zeros((128, 128, 4), np.uint8)
    image[..., :3] = GREEN
    image[30:98, 30:98, 3] = 120
    image[33:95, 33:95, 3] = 255
    image[33:95, 33:64, :3] = RED
    image[33:95, 64:95, :3] = BLUE
    return image


def test_what_is_solid_stays_and_so_does_the_alpha(person: NDArray[np.uint8]) -> None:
    before = person.copy()
    out = continued(person)
    solid = person[..., 3] >= SOLID
    assert np.array_equal(person, before)
    assert np.array_equal(out[..., 3], person[..., 3])
    assert np.array_equal(out[solid], person[solid])


def test_beyond_the_edge_comes_the_nearest_colour(person: NDArray[np.uint8]) -> None:
    out = continued(person)
    for place in ((64, 31), (64, 2), (2, 40), (0, 0)):
        assert np.allclose(out[place][:3], RED, atol=2)
    for place in ((64, 96), (64, 126), (126, 90), (127, 127)):
        assert np.allclose(out[place][:3], BLUE, atol=2)
    assert not (out[..., 1] > 60).any()  # no green is left


def test_without_a_person_nothing_changes(person: NDArray[np.uint8]) -> None:
    person[..., 3] = SOLID - 1
    assert np.array_equal(continued(person), person)


def test_a_wisp_fades_from_its_own_colour_to_that_beside_it(person: NDArray[np.uint8]) -> None:
    """So that an alpha which wavers in motion does not flicker."""
    greens = []
    for alpha in range(FAINT, SOLID + 1):
        person[60:70, 90:95] = (*GREEN, alpha)
        greens.append(int(continued(person)[64, 93, 1]))
    assert greens[0] < 60
    assert greens[-1] == 255
    assert max(np.diff(greens)) < 15


def test_a_frame_is_free_of_fringes(
    pipeline: Pipeline, avatar: Avatar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond the edge there are the colours of the nearest solid pixels, which without this module
    there are not."""

    def off() -> float:
        frame = pipeline.render(avatar)
        solid = (frame.alpha < SOLID).astype(np.uint8)
        _, labels = cv2.distanceTransformWithLabels(
            solid, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        table = np.zeros((labels.max() + 1, 3))
        table[labels[solid == 0]] = frame.rgb[solid == 0]
        return float(np.abs(table[labels] - frame.rgb)[frame.alpha < 20].mean())

    found = off()  # not 0, for it works at half the resolution
    assert found < 12
    monkeypatch.setattr(mix, "continued", lambda rgba: rgba)
    assert off() > 2 * found
