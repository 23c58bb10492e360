"""What training does to pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cvthead.images import read_image
from cvthead.training.augmentation import DEGRADED_SHARE, colour_jitter, degraded

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
DRAWN = 60


def test_some_sources_are_poorer_but_show_the_same() -> None:
    image = np.ascontiguousarray(cv2.resize(read_image(PORTRAIT), (256, 256)), np.uint8)
    before = image.copy()
    made = [degraded(np.random.default_rng(number), image) for number in range(DRAWN)]
    assert np.array_equal(image, before)
    assert all(each.shape == image.shape and each.dtype == np.uint8 for each in made)
    poor = [each for each in made if each is not image]
    assert len(poor) == pytest.approx(DEGRADED_SHARE * DRAWN, abs=8)

    def detail(picture: np.ndarray) -> float:
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean())

    for each in poor:
        assert detail(each) < detail(image)
        error = ((each.astype(float) - image) ** 2).mean()
        assert 10 * np.log10(255**2 / error) > 22  # the same person, in the same place
    assert len({each.tobytes() for each in poor}) == len(poor)


def test_colours_change_alike_for_all_pictures_of_a_sample() -> None:
    grey = np.full((2, 2, 3), 0.5, np.float32)
    changed = [colour_jitter(np.random.default_rng(number))(grey) for number in range(DRAWN)]
    for picture in changed:
        assert (picture == picture[0, 0]).all()
        assert picture.min() >= 0
        assert picture.max() <= 1
    assert np.ptp([picture.mean() for picture in changed]) > 0.1
