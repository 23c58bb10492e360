"""Camera and crop agree on where things are, to a fraction of a pixel."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS, Camera, Crop
from cvthead.controls import Controls
from cvthead.errors import CoefficientsError

WIDTH, HEIGHT = 1001, 603


def blob(x: float, y: float, radius: float) -> NDArray[np.uint8]:
    """A picture with a soft dot at continuous pixel coordinates."""
    columns, rows = np.arange(WIDTH) + 0.5 - x, np.arange(HEIGHT) + 0.5 - y
    value = 250 * np.exp(-(columns[None] ** 2 + rows[:, None] ** 2) / (2 * radius**2))
    return np.repeat(value.round().astype(np.uint8)[..., None], 3, axis=2)


def centre(image: NDArray[np.uint8]) -> tuple[float, float]:
    weight = image[..., 0].astype(float)
    at = np.arange(len(weight)) + 0.5
    total = weight.sum()
    return float(weight.sum(axis=0) @ at / total), float(weight.sum(axis=1) @ at / total)


@pytest.mark.parametrize(
    ("crop", "spot"),
    [
        (Crop(400, -20, 640), (930.0, 70.0)),  # shrinks, at the far side
        (Crop(-100.3, 80.7, 517.0), (300.0, 511.0)),
        (Crop(700, 300, 256), (811.0, 400.0)),
        (Crop(801.5, 250.25, 100), (850.0, 300.0)),  # enlarges
    ],
)
def test_a_spot_lands_where_the_cameras_put_it(crop: Crop, spot: tuple[float, float]) -> None:
    camera = Camera(900.0, 0.4, -0.3)
    point = np.array([spot[0] / 900 - 0.4, -spot[1] / 900 + 0.3, 0.1])
    np.testing.assert_allclose(camera.project(point)[:2], spot, atol=1e-3)
    picture, valid = crop.cut(blob(*spot, radius=crop.size / 40))
    expected = (camera.in_crop(crop).project(point)[:2] + 1) * (CROP_PIXELS / 2)
    assert valid[int(expected[1]), int(expected[0])]
    np.testing.assert_allclose(centre(picture), expected, atol=0.05)


def test_valid_is_false_beyond_the_picture() -> None:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    _, valid = Crop(-128, -64, 512).cut(image)
    assert not valid[:, :64].any()
    assert not valid[:32].any()
    assert valid[32:, 64:].all()


@pytest.mark.parametrize(
    "values", [(0, 0, 0), (-1, 0, 0), (np.nan, 0, 0), (1, np.inf, 0), (1e9, 0, 0)]
)
def test_a_camera_that_cannot_project_is_refused(values: tuple[float, float, float]) -> None:
    with pytest.raises(CoefficientsError, match="camera"):
        Controls(camera=Camera(*values))
