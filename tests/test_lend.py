"""What is hidden keeps its points' colours; the network adds what is finer."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.runtime.fill import ZERO
from cvthead.runtime.lend import SURE, hidden_share, lend

Codes = NDArray[np.uint8]

SIZE = 64
CODE, BYTE = 60, 59.5  # of the same colour
EVERYWHERE = np.ones((SIZE, SIZE), np.float32)  # the colours are those of points


@pytest.fixture
def painted() -> Codes:
    noise = np.random.default_rng(0).integers(0, 256, (2 * SIZE, 2 * SIZE, 4), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2), np.uint8)


@pytest.fixture
def colours() -> Codes:
    return np.full((SIZE, SIZE, 3), CODE, np.uint8)


def test_what_is_hidden_has_the_colour_of_its_points(painted: Codes, colours: Codes) -> None:
    hidden = np.zeros((SIZE, SIZE), np.float32)
    hidden[:, :32] = 1
    lent = lend(painted, colours, hidden, EVERYWHERE)
    halved = cv2.resize(lent, (SIZE, SIZE), interpolation=cv2.INTER_AREA)[:, :30, :3]
    assert abs(halved.mean() - BYTE) < 1
    assert halved.std() < 0.3 * cv2.resize(painted, (SIZE, SIZE))[..., :3].std()
    assert np.array_equal(lent[:, 66:], painted[:, 66:])
    assert np.array_equal(lent[..., 3], painted[..., 3])


def test_what_is_seen_stays(painted: Codes, colours: Codes) -> None:
    nothing = np.zeros((SIZE, SIZE), np.float32)
    assert np.array_equal(lend(painted, colours, nothing, EVERYWHERE), painted)


def test_what_is_finer_than_the_points_stays(colours: Codes) -> None:
    stripes = np.full((2 * SIZE, 2 * SIZE, 4), 100, np.uint8)
    stripes[::2] = 140
    lent = lend(stripes, colours, EVERYWHERE, EVERYWHERE)[..., :3].astype(float)
    assert lent[1::2].mean() - lent[::2].mean() == pytest.approx(-40, abs=1)
    assert lent.mean() == pytest.approx(BYTE, abs=1)


def test_the_grey_of_wide_holes_is_not_lent(painted: Codes) -> None:
    part = EVERYWHERE.copy()
    part[:, 20:40], part[:, 40:] = 0.5, 0
    mixed = np.rint(ZERO + (CODE - ZERO) * part).astype(np.uint8)
    lent = lend(painted, np.repeat(mixed[..., None], 3, axis=2), EVERYWHERE, part)
    halved = cv2.resize(lent, (SIZE, SIZE), interpolation=cv2.INTER_AREA)[..., :3]
    assert abs(halved[:, :38].mean() - BYTE) < 1.5
    assert np.array_equal(lent[:, 84:], painted[:, 84:])


def test_the_share_counts_the_points_around() -> None:
    rng = np.random.default_rng(0)
    known = rng.random((SIZE, SIZE)) < 0.5
    seen = np.zeros((SIZE, SIZE), np.bool_)
    seen[:, 32:] = True
    share = hidden_share(seen, known)
    assert (share[:, :28] == 1).all()
    assert (share[:, 36:] == 0).all()
    few = hidden_share(rng.random((SIZE, SIZE)) < SURE / 2, known)
    assert few.mean() == pytest.approx(0.5, abs=0.05)
    assert (hidden_share(seen, np.zeros_like(known)) == 1).all()
