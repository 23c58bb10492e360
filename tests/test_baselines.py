from __future__ import annotations

import numpy as np
import pytest

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.deformation import Deformation
from cvthead.evaluation.baselines import (
    DISC_CORNERS,
    ColouredMesh,
    disc_fans,
    fill,
    in_pixels,
    visible,
)
from cvthead.evaluation.rasteriser import owners, shade
from cvthead.head.model import HeadModel, Region

FACES = np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32)
RED, GREEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.load()


@pytest.fixture(scope="module")
def camera(head: HeadModel) -> Camera:
    centre = head.template[head.region == Region.FACE].mean(0)
    return Camera(2 / 0.36, float(-centre[0]), float(-centre[1]))


def two_triangles(first_depth: float, second_depth: float) -> np.ndarray:
    """Two triangles over each other, covering the upper left half of 16 x 16 pixels."""
    corners = [(0, 0), (16, 0), (0, 16)]
    return np.array(
        [(*c, first_depth) for c in corners] + [(*c, second_depth) for c in corners], np.float32
    )


@pytest.mark.parametrize(("depths", "winner"), [((1, 2), 0), ((2, 1), 1), ((-3, 0), 0)])
def test_nearer_triangle_wins(depths: tuple[float, float], winner: int) -> None:
    owner, bary, depth = owners(two_triangles(*depths), FACES, 16)
    covered = owner >= 0
    assert covered.sum() in range(16 * 16 // 2 - 16, 16 * 16 // 2 + 17)
    assert (owner[covered] == winner).all()
    assert depth[covered] == pytest.approx(min(depths))
    colours = np.array([RED] * 3 + [GREEN] * 3, np.float32)
    assert shade(owner, bary, FACES, colours)[2, 2].tolist() == pytest.approx((RED, GREEN)[winner])


def test_crossing_triangles_are_split_by_depth() -> None:
    positions = two_triangles(0, 0)
    positions[:3, 2] = positions[:3, 0]  # the first recedes to the right
    positions[3:, 2] = 5
    owner = owners(positions, FACES, 16)[0]
    assert owner[2, 2] == 0
    assert owner[2, 9] == 1


def test_interpolation_is_linear() -> None:
    positions = np.array([[0, 0, 0], [32, 0, 0], [0, 32, 0]], np.float32)
    values = positions[:, :2].copy()
    owner, bary, _ = owners(positions, FACES[:1], 32)
    image = shade(owner, bary, FACES[:1], values)
    assert image[4, 9] == pytest.approx([9.5, 4.5], abs=1e-4)


def test_triangles_sharing_an_edge_leave_no_gap() -> None:
    positions = np.array(
        [[0.3, 0.2, 0], [31.7, 0.4, 0], [30.9, 31.8, 0], [0.1, 31.1, 0]], np.float32
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    assert (owners(positions, faces, 32)[0][2:30, 2:30] >= 0).all()


def test_everything_outside_the_image_is_no_error() -> None:
    positions = two_triangles(0, 1) + np.array([100, -100, 0], np.float32)
    owner, _, depth = owners(positions, FACES, 16)
    assert (owner == -1).all()
    assert np.isinf(depth).all()


def test_hidden_points_take_their_mirror_then_the_nearest() -> None:
    colours = np.array([RED, GREEN, (0, 0, 1), (1, 1, 1)], np.float32)
    seen = np.array([True, False, False, False])
    positions = np.array([[0, 0, 0], [1, 0, 0], [5, 0, 0], [0.2, 0, 0]], np.float32)
    filled = fill(colours, seen, np.array([1, 0, 2]), positions)
    assert filled[:2].tolist() == [list(RED), list(RED)]
    # Vertex 2 is its own mirror, point 3 is of the shell: nearest known point.
    assert filled[2:].tolist() == [list(RED), list(RED)]
    assert fill(colours, np.zeros(4, bool), np.array([1, 0, 2]), positions).max() == 0.5


def test_disc_is_round_and_of_the_radius() -> None:
    centres = np.array([[16, 16, 0]], np.float32)
    rim, faces = disc_fans(centres, 0, 8)
    assert len(rim) == len(faces) == DISC_CORNERS
    area = (owners(np.concatenate([centres, rim]), faces, 32)[0] >= 0).sum()
    octagon = DISC_CORNERS / 2 * 64 * np.sin(2 * np.pi / DISC_CORNERS)
    assert area == pytest.approx(octagon, rel=0.06)


def test_the_face_is_visible_from_the_front_and_hidden_from_behind(
    head: HeadModel, camera: Camera
) -> None:
    everywhere = np.ones((256, 256), bool)
    share = {}
    for name, turn in {"front": 0.0, "back": np.pi}.items():
        coefficients = Coefficients.zeros().with_joints({"global": [0, turn, 0]})
        projected = in_pixels(camera.project(head.vertices(coefficients)), 256)
        seen = visible(projected, head.faces, everywhere, 3.5)
        share[name] = seen[head.region == Region.FACE].mean()
    assert share["front"] > 0.8
    assert share["back"] < 0.1


def test_half_masked_source_gives_a_symmetric_head(head: HeadModel, camera: Camera) -> None:
    """Only the subject's left half may be read: the right half is its mirror image."""
    crop = np.zeros((256, 256, 3), np.uint8)
    crop[..., 0] = np.linspace(0, 255, 256)
    crop[..., 1] = np.linspace(0, 255, 256)[:, None]
    half = np.zeros((256, 256), bool)
    half[:, 126:] = True
    source = Coefficients.zeros()
    mesh = ColouredMesh.from_picture(head, source, camera, Deformation.none(head), crop, half)
    image, alpha = mesh.render(source, camera)
    assert image.shape == (256, 256, 3)
    assert alpha.min() == 0
    assert alpha.max() == 1
    middle = slice(60, 180)
    assert np.abs(image[middle] - image[middle, ::-1]).mean() < 0.02
    assert image[middle, 60:90, 0].mean() > 0.6


def test_shell_points_add_coverage_outside_the_mesh(head: HeadModel, camera: Camera) -> None:
    top = int(head.template[:, 1].argmax())
    shell = Deformation(
        np.zeros_like(head.template),
        np.array([top], np.int32),
        np.array([[0, 0.012, 0]], np.float32),
    )
    neutral = Coefficients.zeros()
    alphas = []
    for deformation in (Deformation.none(head), shell):
        count = len(head.template) + len(deformation.shell_anchor)
        colours = np.full((count, 3), 0.2, np.float32)
        alphas.append(ColouredMesh(head, neutral, deformation, colours).render(neutral, camera)[1])
    gained = alphas[1].sum() - alphas[0].sum()
    assert (alphas[1] >= alphas[0]).all()
    assert 5 < gained < 100
