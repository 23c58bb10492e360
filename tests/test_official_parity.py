"""The imported official model gives the released code's numbers, from picture to picture.

tests/test_paper_parity.py follows the arrays inside the descriptor network and the U-Net.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import made_official
import numpy as np
import official
import pytest
import torch
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.official import torch_files
from cvthead.official.avatar import OfficialAvatar
from cvthead.official.crop import FaceSquare
from cvthead.official.importer import read_release, write_model
from cvthead.official.mesh import read_hierarchy
from cvthead.official.networks import foreground, picture_array
from cvthead.official.painted import HARD_MASK
from cvthead.official.pipeline import OfficialPipeline
from cvthead.official.splat import nearest_points
from cvthead.official.tracker import Picture

NETWORK_TOLERANCE = 1e-3  # of the array's standard deviation
GEOMETRY_TOLERANCE = 1e-5
SIZE = 256


@pytest.fixture(scope="module")
def reference(shared: Path) -> official.Arrays:
    return official.arrays(shared, "sample_a")


@pytest.fixture(scope="module")
def inputs(shared: Path) -> official.Arrays:
    return official.arrays(shared, "inputs")


@pytest.fixture(scope="module")
def pipeline(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[OfficialPipeline]:
    """Of a release with the reference run's weights, imported without the 8-bit U-Net."""
    release = tmp_path_factory.mktemp("release")
    weights = official.checkpoint(shared) | fixed_parts(shared)
    made_official.write_whole(release, weights, official.transforms(shared))
    del weights
    (release / "imported").mkdir()
    write_model(release / "imported", *read_release(release))
    yield OfficialPipeline.load(release / "imported", precision="float32")
    shutil.rmtree(release)


def fixed_parts(shared: Path) -> dict[str, torch.Tensor]:
    """What the seeded weights leave to data files."""
    data = shared / "reference" / "official-data"
    head = official.flame(shared)
    flame = made_official.flame_state() | {
        "v_template": head.template,
        "shapedirs": np.concatenate([head.shape_basis, head.expression_basis], axis=2),
        "posedirs": head.pose_basis,
        "J_regressor": head.joint_regressor,
        "lbs_weights": head.weights,
        "faces_tensor": head.faces.astype(np.int64),
    }
    # Released as CUDA tensors.
    mean = torch_files.load_tensor(data / "mean_deform.pt")
    basis = torch_files.load_tensor(data / "u_full.pt")
    return {f"deca.flame.{key}": torch.from_numpy(np.array(a)) for key, a in flame.items()} | {
        "face_parsing.mean": torch.tensor([0.485, 0.456, 0.406]),
        "face_parsing.std": torch.tensor([0.229, 0.224, 0.225]),
        "deform_mean": mean,
        "deform_basis": basis.reshape(-1, 3, basis.shape[1]),
    }


@pytest.fixture(scope="module")
def avatar(pipeline: OfficialPipeline, inputs: official.Arrays) -> OfficialAvatar:
    return pipeline.encode_picture(Picture(inputs["src"], inputs["lmk_src"]))


def assert_close(found: NDArray[Any], expected: NDArray[Any]) -> None:
    assert found.shape == expected.shape
    error = np.abs(found - expected).max() / expected.std()
    assert error < NETWORK_TOLERANCE, f"{error:.1e} standard deviations"


def assert_near(found: NDArray[Any], expected: NDArray[Any]) -> None:
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() < GEOMETRY_TOLERANCE


def test_spirals_are_those_of_openmesh(shared: Path) -> None:
    expected = official.arrays(shared, "spirals")
    found = read_hierarchy(shared / "reference" / "official-data" / "transform.pkl")
    for level in range(2):
        assert np.array_equal(found.spirals[level], expected[f"level{level}"])
        assert np.array_equal(found.down[level], expected[f"down{level}"])


@pytest.mark.parametrize("name", ["src", "drv"])
def test_face_square(name: str, inputs: official.Arrays) -> None:
    square = FaceSquare.around(inputs[f"lmk_{name}"])
    assert_near(square.tform, inputs[f"{name}_tform"])
    assert_near(square.cut(inputs[name]), inputs[f"{name}_crop"])


def test_parsing(
    pipeline: OfficialPipeline, inputs: official.Arrays, reference: official.Arrays
) -> None:
    (logits,) = pipeline.networks.parsing(picture_array(inputs["src"]))
    assert_close(logits[0, :, ::4, ::4], reference["parsing_logits_s4"])
    assert (foreground(logits)[0, 0] == reference["mask"]).mean() >= 0.999


def test_deca(
    pipeline: OfficialPipeline, inputs: official.Arrays, reference: official.Arrays
) -> None:
    (codes,) = pipeline.networks.deca(inputs["src_crop"][None])
    assert_close(codes[0], reference["deca_codes"])
    square = FaceSquare.around(inputs["lmk_src"])
    estimate = pipeline.tracker.estimate(inputs["src"], square)
    vertices = pipeline.head.vertices(estimate.coefficients)
    assert_near(vertices, reference["src_verts"])
    assert_close(estimate.cam, reference["deca_codes"][206:209])


def test_hair(
    pipeline: OfficialPipeline, inputs: official.Arrays, reference: official.Arrays
) -> None:
    coefficients, offsets = pipeline.networks.hair(picture_array(inputs["src"]))
    assert_close(coefficients[0], reference["hair_beta"])
    assert_near(offsets[0], reference["vtx_deform"])


def test_descriptors(avatar: OfficialAvatar, reference: official.Arrays) -> None:
    assert_close(avatar.descriptors, reference["descriptors"])
    assert_near(avatar.offsets, reference["vtx_deform"])


def test_driven_by_pose(
    pipeline: OfficialPipeline,
    avatar: OfficialAvatar,
    inputs: official.Arrays,
    reference: official.Arrays,
) -> None:
    assert_near(pipeline.pose(avatar, avatar.coefficients, avatar.camera), reference["src_proj"])
    driven = replace(avatar.coefficients, pose=pipeline.tracker.full_pose(inputs["pose_a"][0]))
    points = pipeline.pose(avatar, driven, avatar.camera)
    assert_near(points, reference["drv_proj"])

    owner = nearest_points(points, SIZE).reshape(SIZE, SIZE)
    same = owner + 1 == reference["index_image"]
    assert same.mean() >= 0.999

    painted = pipeline.paint(avatar, points)
    assert_close(painted.raw.transpose(2, 0, 1), reference["unet_raw"])
    for name, threshold in (("final_soft", None), ("final_hard", HARD_MASK)):
        found = pipeline.white(avatar, driven, avatar.camera, threshold=threshold)
        assert np.abs(found.astype(int) - reference[name].astype(int)).max() <= 1


@pytest.mark.parametrize("cross_identity", [True, False])
def test_driven_by_face(
    cross_identity: bool,
    pipeline: OfficialPipeline,
    avatar: OfficialAvatar,
    inputs: official.Arrays,
) -> None:
    """Driver's expression, pose and camera; its tform only in self-reenactment."""
    driven = pipeline.drive_picture(
        avatar, Picture(inputs["drv"], inputs["lmk_drv"]), cross_identity=cross_identity
    )
    coefficients = driven.coefficients
    driver = pipeline.tracker.estimate(inputs["drv"], FaceSquare.around(inputs["lmk_drv"]))
    assert np.array_equal(coefficients.shape, avatar.coefficients.shape)
    assert np.array_equal(coefficients.expression, driver.coefficients.expression)
    assert np.array_equal(coefficients.pose, driver.coefficients.pose)

    # The released code's way: into the crop [-1, 1], its pixels, the picture's pixels, [-1, 1].
    vertices = pipeline.head.vertices(coefficients) + avatar.offsets
    expected = Camera(*driver.cam.tolist()).project(vertices)
    tform = inputs["src_tform" if cross_identity else "drv_tform"]
    pixels = np.column_stack([(0.5 * expected[:, :2] + 0.5) * 224, np.ones(len(expected))])
    expected[:, :2] = (pixels @ np.linalg.inv(tform).T)[:, :2] / SIZE * 2 - 1
    assert_near(pipeline.pose(avatar, *driven), expected)
