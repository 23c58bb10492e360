from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS, Camera
from cvthead.coefficients import Coefficients
from cvthead.deformation import (
    HAIR_FORWARD,
    MAX_EAR_OFFSET,
    MAX_SHELL_POINTS,
    SHELL_SPACING,
    Deformation,
    DeformationModel,
    fit,
    inside,
    points,
    shell_spots,
    to_pixels,
)
from cvthead.errors import FaceError
from cvthead.evaluation.deformation import measure
from cvthead.evaluation.tracking import read_image
from cvthead.head.mesh import vertex_normals
from cvthead.head.model import HeadModel, Region
from cvthead.silhouette import distance_to_points, overlap, person_mask, rasterise
from cvthead.source import cut_head
from cvthead.tracking.tracker import Tracker

Mask = NDArray[np.bool_]
EVERYWHERE = np.ones((CROP_PIXELS, CROP_PIXELS), dtype=bool)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.load()


@pytest.fixture(scope="module")
def model(head: HeadModel) -> DeformationModel:
    return DeformationModel.from_head(head)


@pytest.fixture(scope="module")
def camera(head: HeadModel) -> Camera:
    centre = head.template[head.region == Region.FACE].mean(axis=0)
    return Camera(2 / 0.36, float(-centre[0]), float(-centre[1]))


@pytest.fixture(scope="module")
def posed() -> Coefficients:
    """A head that is turned, nods, and opens its mouth."""
    return Coefficients.zeros().with_joints(
        {"global": [0.1, 0.3, -0.05], "neck": [0.05, 0.1, 0], "jaw": [0.2, 0, 0]}
    )


def haired(head: HeadModel, camera: Camera, coefficients: Coefficients) -> Mask:
    """The head's own silhouette with long hair around it."""
    flat = to_pixels(camera.project(head.vertices(coefficients)))
    mask = rasterise(flat, head.faces, CROP_PIXELS).astype(np.uint8)
    scalp = flat[head.region == Region.SCALP]
    top, middle = scalp.min(axis=0)[1], scalp.mean(axis=0)[0]
    cv2.ellipse(mask, (int(middle), int(top) + 90), (78, 110), 0, 0, 360, 1, -1)
    return mask.astype(bool)


@pytest.fixture(scope="module")
def mask(head: HeadModel, camera: Camera, posed: Coefficients) -> Mask:
    return haired(head, camera, posed)


@pytest.fixture(scope="module")
def fitted(model: DeformationModel, posed: Coefficients, camera: Camera, mask: Mask) -> Deformation:
    return model.fit(posed, camera, mask, EVERYWHERE)


def test_face_does_not_move_and_ears_hardly(head: HeadModel, fitted: Deformation) -> None:
    pinned = np.isin(head.region, [Region.FACE, Region.EYES, Region.MOUTH])
    length = np.linalg.norm(fitted.offsets, axis=1)
    assert length[pinned].max() == 0
    assert length[head.region == Region.EARS].max() <= MAX_EAR_OFFSET * 1.0001
    assert length[head.region == Region.SCALP].max() > 0.01


def test_fills_the_mask(
    head: HeadModel, camera: Camera, posed: Coefficients, mask: Mask, fitted: Deformation
) -> None:
    count = len(head.template)

    def silhouette(deformation: Deformation) -> Mask:
        flat = to_pixels(camera.project(points(head, posed, deformation)))
        return rasterise(flat[:count], head.faces, CROP_PIXELS)

    before = overlap(silhouette(Deformation.none(head)), mask, EVERYWHERE)
    after = overlap(silhouette(fitted), mask, EVERYWHERE)
    assert after > 0.9 > before


def test_every_shell_point_lies_in_the_mask_and_covers_a_gap(
    head: HeadModel, camera: Camera, posed: Coefficients, mask: Mask, fitted: Deformation
) -> None:
    positions = points(head, posed, fitted)[len(head.template) :]
    assert 0 < len(positions) == len(fitted.shell_anchor) <= MAX_SHELL_POINTS
    assert inside(positions, camera, mask).all()
    flat = to_pixels(camera.project(positions)).astype(np.float64)
    gaps = np.linalg.norm(flat[:, None] - flat[None], axis=2) + 99 * np.eye(len(flat))
    assert gaps.min() > SHELL_SPACING - 0.5
    assert np.isin(
        head.region[fitted.shell_anchor], [Region.SCALP, Region.NECK, Region.SHOULDERS]
    ).all()


def test_shell_has_the_depth_of_its_anchor(
    head: HeadModel, posed: Coefficients, fitted: Deformation
) -> None:
    positions = points(head, posed, fitted)
    shell = positions[len(head.template) :, 2]
    np.testing.assert_allclose(shell, positions[fitted.shell_anchor, 2], atol=1e-4)


def test_hair_lies_in_front_of_the_scalp_it_grows_from(
    head: HeadModel, posed: Coefficients, fitted: Deformation
) -> None:
    bald = head.vertices(posed)
    nearer = (points(head, posed, fitted)[: len(bald)] - bald)[:, 2]
    normals = vertex_normals(bald, head.faces)
    scalp = head.region == Region.SCALP
    before = scalp & (normals[:, 2] > 0)
    assert nearer[before].min() > -1e-4
    assert 0.005 < nearer[before].max() < HAIR_FORWARD + 1e-4
    assert nearer[scalp & (normals[:, 2] < -0.5)].max() < 1e-4  # at the back it goes back


def test_hair_turns_rigidly_with_the_head(
    head: HeadModel, posed: Coefficients, fitted: Deformation
) -> None:
    turn = cv2.Rodrigues(np.array([0.0, np.radians(40), 0.0]))[0]
    before = cv2.Rodrigues(posed.joint("global").astype(np.float64))[0]
    after = posed.with_joints({"global": cv2.Rodrigues(turn @ before)[0][:, 0]})
    root = head.joints(head.rest(posed))[0]
    expected = (points(head, posed, fitted) - root) @ turn.T + root
    np.testing.assert_allclose(points(head, after, fitted), expected, atol=2e-5)


def test_none_is_the_plain_head(head: HeadModel, posed: Coefficients) -> None:
    plain = points(head, posed, Deformation.none(head))
    np.testing.assert_allclose(plain, head.vertices(posed), atol=1e-6)


def test_a_mask_equal_to_the_silhouette_changes_little(
    head: HeadModel, model: DeformationModel, camera: Camera
) -> None:
    coefficients = Coefficients.zeros()
    flat = to_pixels(camera.project(head.vertices(coefficients)))
    silhouette = rasterise(flat, head.faces, CROP_PIXELS)
    fitted = model.fit(coefficients, camera, silhouette, EVERYWHERE)
    length = np.linalg.norm(fitted.offsets, axis=1)
    assert np.median(length) < 0.002
    assert len(fitted.shell_anchor) < 20


def test_what_lies_beyond_the_picture_pulls_nothing_in(
    head: HeadModel, model: DeformationModel, camera: Camera, mask: Mask, posed: Coefficients
) -> None:
    """A portrait cut off at the chin keeps its shoulders."""
    valid = EVERYWHERE.copy()
    valid[170:] = False
    fitted = model.fit(posed, camera, mask, valid)
    shoulders = fitted.offsets[head.region == Region.SHOULDERS]
    assert np.median(np.linalg.norm(shoulders, axis=1)) < 0.02
    shell = points(head, posed, fitted)[len(head.template) :]
    assert inside(shell, camera, mask & valid).all()


@pytest.mark.parametrize("corner", [False, True])
def test_a_mask_without_the_face_is_refused(
    head: HeadModel, camera: Camera, posed: Coefficients, corner: bool
) -> None:
    elsewhere = np.zeros((CROP_PIXELS, CROP_PIXELS), dtype=bool)
    elsewhere[:20, :20] = corner
    with pytest.raises(FaceError, match="face"):
        fit(head, posed, camera, elsewhere, EVERYWHERE)
    with pytest.raises(FaceError, match="person"):
        person_mask(elsewhere.astype(np.float32), EVERYWHERE, np.array([[128.0, 128.0]]))


def test_person_mask_keeps_the_region_with_the_face() -> None:
    probability = np.zeros((CROP_PIXELS, CROP_PIXELS), dtype=np.float32)
    probability[40:200, 90:160] = 0.9
    probability[:, 190:] = 0.99  # someone else, and larger
    probability[40:200, 60:90] = 0.4
    valid = EVERYWHERE.copy()
    valid[180:] = False
    expected = np.zeros_like(valid)
    expected[40:180, 90:160] = True
    face = np.array([[120.0, 100.0], [130.0, 110.0], [-5.0, 400.0]])
    np.testing.assert_array_equal(person_mask(probability, valid, face), expected)


def test_shell_spots_leave_no_gap_and_stop_at_the_bound() -> None:
    square = np.zeros((CROP_PIXELS, CROP_PIXELS), dtype=bool)
    square[100:140, 100:140] = True
    square[200:240, 200:240] = True  # out of reach: nobody's hair
    mesh = np.array([[120.5, 120.5]])
    spots = shell_spots(mesh, square)
    covered = distance_to_points(np.concatenate([mesh, spots]), CROP_PIXELS)
    assert 0 < len(spots) < 100
    assert spots.max() < 141
    # The margin at the mask's edge stays empty by design; a pixel inside it may not.
    assert covered[103:137, 103:137].max() <= SHELL_SPACING + 0.5
    grid = np.stack(np.meshgrid(np.arange(20, 256, 40), np.arange(20, 256, 40)), -1)
    assert len(shell_spots(grid.reshape(-1, 2) + 0.5, EVERYWHERE)) == MAX_SHELL_POINTS


def test_rasterise_covers_a_triangle_seen_from_the_front_only() -> None:
    corners = np.array([[10.0, 10.0], [10.0, 50.0], [50.0, 10.0]])
    drawn = rasterise(corners, np.array([[0, 1, 2]]), 64)
    assert drawn[20, 20]
    assert not drawn[45, 45]
    assert abs(np.count_nonzero(drawn) - 800) < 90  # the edge's pixels count as covered
    assert not rasterise(corners, np.array([[0, 2, 1]]), 64).any()


def test_real_portraits(shared: Path, head: HeadModel, model: DeformationModel) -> None:
    """Within the targets on a few validation stills, long hair among them."""
    tracker = Tracker.load(head)
    results = []
    for path in sorted((shared / "data/stills/val").iterdir())[::30]:
        image = read_image(path)
        results.append(measure(model, cut_head(tracker, image, tracker.track(image))))
    assert all(result.mesh > result.bald for result in results)
    assert np.mean([result.mesh for result in results]) > 0.9
    assert np.mean([result.outside for result in results]) < 0.1
    assert max(result.ear for result in results) <= MAX_EAR_OFFSET * 1e3 * 1.0001


def test_expression_leaves_hair_alone(
    head: HeadModel, posed: Coefficients, fitted: Deformation
) -> None:
    smiling = replace(posed, expression=np.full(50, 0.3, np.float32))
    moved = points(head, smiling, fitted) - points(head, posed, fitted)
    bald = head.vertices(smiling) - head.vertices(posed)
    np.testing.assert_allclose(moved[: len(bald)], bald, atol=2e-5)
