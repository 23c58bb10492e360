"""Posing and projecting a FLAME model gives the released code's vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import official
import pytest

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.head.model import HeadModel

GEOMETRY_TOLERANCE = 1e-5
DECA_CROP, IMAGE = 224, 256


@pytest.fixture(scope="module")
def flame(shared: Path) -> HeadModel:
    return official.flame(shared)


@pytest.mark.parametrize("name", ["src", "drv"])
def test_posed_and_projected_vertices(name: str, flame: HeadModel, shared: Path) -> None:
    inputs, sample = official.arrays(shared, "inputs"), official.arrays(shared, "sample_a")
    codes = sample["deca_codes"]
    pose = codes[200:206] if name == "src" else inputs["pose_a"][0]
    coefficients = Coefficients(
        shape=codes[:100],
        expression=codes[150:200],
        pose=np.concatenate([pose[:3], np.zeros(3), pose[3:], np.zeros(6)]),
    )
    vertices = flame.vertices(coefficients)
    assert np.abs(vertices - sample[f"{name}_verts"]).max() < GEOMETRY_TOLERANCE

    camera = Camera(*(float(value) for value in codes[206:209]))
    projected = camera.project(vertices + sample["vtx_deform"])
    # DECA's crop [-1, 1] -> crop pixels -> pixels of the image -> [-1, 1]
    crop_pixels = (0.5 * projected[:, :2] + 0.5) * DECA_CROP
    homogeneous = np.column_stack([crop_pixels, np.ones(len(crop_pixels))])
    pixels = homogeneous @ np.linalg.inv(inputs["src_tform"]).T
    projected[:, :2] = pixels[:, :2] / IMAGE * 2 - 1
    assert np.abs(projected - sample[f"{name}_proj"]).max() < GEOMETRY_TOLERANCE
