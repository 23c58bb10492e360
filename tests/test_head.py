"""The open head keeps FLAME's promises."""

from __future__ import annotations

import zipfile
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from cvthead.coefficients import Coefficients
from cvthead.errors import AssetError, CoefficientsError
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.mesh import edges
from cvthead.head.model import HeadModel, Region, read_arrays, rotations, skin
from tools.decimate import linked

ASSETS = Path(__file__).parents[1] / "cvthead" / "assets"
FLIP = np.array([-1.0, 1.0, 1.0], np.float32)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.load()


def coefficients_of(shape: ArrayLike, expression: ArrayLike, pose: ArrayLike) -> Coefficients:
    return Coefficients(*(np.asarray(x, np.float32) for x in (shape, expression, pose)))


def random_coefficients(seed: int) -> Coefficients:
    rng = np.random.default_rng(seed)
    return coefficients_of(
        0.5 * rng.normal(size=100), rng.normal(size=50), 0.3 * rng.normal(size=15)
    )


def rotation(axis_angle: list[float]) -> NDArray[np.float64]:
    return np.asarray(cv2.Rodrigues(np.array(axis_angle, float))[0], np.float64)


def test_zero_coefficients_give_the_template(head: HeadModel) -> None:
    np.testing.assert_allclose(head.vertices(Coefficients.zeros()), head.template, atol=1e-7)


def test_global_rotations_compose(head: HeadModel) -> None:
    """Turning by R1 and then R2 is one turn by R2 R1, up to a translation."""
    base = random_coefficients(1)
    first, second = [0.2, 0.5, -0.1], [-0.3, 0.2, 0.4]
    both = cv2.Rodrigues(rotation(second) @ rotation(first))[0].ravel()
    once = head.vertices(base.with_joints({"global": first}))
    turned = once @ rotation(second).T.astype(np.float32)
    at_once = head.vertices(base.with_joints({"global": both}))
    np.testing.assert_allclose(at_once - at_once[0], turned - turned[0], atol=1e-5)


def test_global_rotation_keeps_the_root_joint(head: HeadModel) -> None:
    coefficients = random_coefficients(2).with_joints({"global": [0.4, -0.7, 0.2]})
    joints = head.joints(head.rest(coefficients))
    root = head.transforms(coefficients.pose, joints)[0]
    np.testing.assert_allclose(root[:, :3] @ joints[0] + root[:, 3], joints[0], atol=1e-6)


def test_rotations_match_opencv() -> None:
    angles = np.random.default_rng(3).normal(size=(20, 3)).astype(np.float32)
    expected = np.array([cv2.Rodrigues(a.astype(float))[0] for a in angles])
    np.testing.assert_allclose(rotations(angles), expected, atol=2e-6)


def test_expression_does_not_move_the_joints(head: HeadModel) -> None:
    """One standard deviation of any coefficient: under 0.2 mm."""
    moved = np.einsum("jn,nck->jck", head.joint_regressor, head.expression_basis)
    assert np.linalg.norm(moved, axis=1).max() < 2e-4


def test_expression_and_jaw_leave_skull_and_shoulders_alone(head: HeadModel) -> None:
    coefficients = random_coefficients(4)
    still = np.isin(head.region, [Region.SCALP, Region.SHOULDERS])
    neutral = coefficients_of(coefficients.shape, np.zeros(50), np.zeros(15))
    moving = coefficients_of(coefficients.shape, coefficients.expression, np.zeros(15))
    moving = moving.with_joints({"jaw": [0.3, 0, 0]})
    away = np.linalg.norm(head.vertices(moving) - head.vertices(neutral), axis=1)
    assert away[still].max() < 1e-3 < away[head.region == Region.FACE].max()


def test_mirrored_coefficients_mirror_the_head(head: HeadModel) -> None:
    coefficients = random_coefficients(5)
    pose = coefficients.pose.reshape(5, 3)[[0, 1, 2, 4, 3]] * [1, -1, -1]
    mirrored = coefficients_of(
        coefficients.shape * head.shape_parity,
        coefficients.expression * head.expression_parity,
        pose.ravel(),
    )
    expected = head.vertices(coefficients)[head.mirror] * FLIP
    np.testing.assert_allclose(head.vertices(mirrored), expected, atol=2e-6)


def test_mirror_is_a_bijection_that_keeps_regions_and_faces(head: HeadModel) -> None:
    np.testing.assert_array_equal(head.mirror[head.mirror], np.arange(len(head.mirror)))
    np.testing.assert_array_equal(head.region[head.mirror], head.region)
    faces = {frozenset(f) for f in head.faces.tolist()}
    assert {frozenset(f) for f in head.mirror[head.faces].tolist()} == faces


def test_every_part_is_in_one_piece_on_either_side(head: HeadModel) -> None:
    """An island of scalp in the neck would lend it the hair's colour."""
    pairs, pieces = edges(head.faces), {}
    for part in Region:
        label = linked(len(head.template), pairs[(head.region[pairs] == part).all(axis=1)])
        pieces[part.name] = len(np.unique(label[head.region == part]))
    single = dict.fromkeys(("SHOULDERS", "NECK", "SCALP", "FACE"), 1)
    assert pieces == single | {"EYES": 2, "EARS": 2, "MOUTH": 3}  # teeth above, below, tongue


def test_positive_yaw_turns_to_the_subjects_left(head: HeadModel) -> None:
    nose = head.template[:, 2].argmax()
    turned = head.vertices(Coefficients.zeros().with_joints({"global": [0, 0.5, 0]}))
    assert turned[nose, 0] > 0.04


def test_neck_rotation_leaves_the_border_alone(head: HeadModel) -> None:
    turned = head.vertices(Coefficients.zeros().with_joints({"neck": [0, 0.5, 0]}))
    border = head.template[:, 1] < head.template[:, 1].min() + 1e-4
    np.testing.assert_allclose(turned[border], head.template[border], atol=5e-4)
    assert turned[head.template[:, 2].argmax(), 0] > 0.03


def test_offsets_turn_with_the_head(head: HeadModel) -> None:
    coefficients = random_coefficients(6)
    rng = np.random.default_rng(6)
    offsets = rng.normal(0, 0.01, head.template.shape).astype(np.float32)
    joints = head.joints(head.rest(coefficients))
    linear = head.transforms(coefficients.pose, joints).copy()
    linear[:, :, 3] = 0
    expected = head.vertices(coefficients) + skin(offsets, head.weights, linear)
    np.testing.assert_allclose(head.posed(coefficients, offsets), expected, atol=1e-6)


def test_extra_points_follow_their_anchors(head: HeadModel) -> None:
    coefficients = random_coefficients(7)
    anchors = np.array([5, 700, 3000], np.int32)
    nothing = np.zeros((3, 3), np.float32)
    points = head.posed(coefficients, extra=(anchors, nothing))
    assert points.shape == (len(head.template) + 3, 3)
    np.testing.assert_allclose(points[-3:], points[anchors], atol=1e-7)


def test_skinning_weights_and_regressor_are_partitions_of_unity(head: HeadModel) -> None:
    assert head.weights.min() >= 0
    np.testing.assert_allclose(head.weights.sum(1), 1, atol=1e-6)
    np.testing.assert_allclose(head.joint_regressor.sum(1), 1, atol=1e-5)


def test_surface_is_a_manifold_with_a_straight_border(head: HeadModel) -> None:
    edges: Counter[tuple[int, int]] = Counter()
    for a, b, c in head.faces.tolist():
        edges.update([(a, b), (b, c), (c, a)])
    assert max(edges.values()) == 1, "two faces run along an edge in the same direction"
    border = [edge for edge in edges if edge[::-1] not in edges]
    ends = np.unique(border)
    bust = ends[np.isin(head.region[ends], [Region.SHOULDERS, Region.NECK, Region.SCALP])]
    low = np.abs(head.template[bust, 1] - head.template[:, 1].min()) < 1e-5
    side = np.abs(np.abs(head.template[bust, 0]) - head.template[:, 0].max()) < 1e-5
    assert (low | side).all()
    holes = set(head.region[np.setdiff1d(ends, bust)].tolist())
    assert holes == {Region.FACE, Region.MOUTH}  # eye and mouth openings; rows of teeth


def test_faces_look_outwards(head: HeadModel) -> None:
    """The convex back of the head, seen from the middle of the skull."""
    corners = head.template[head.faces[(head.region[head.faces] == Region.SCALP).all(1)]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = corners.mean(1) - np.array([0, 0.05, 0.02])
    assert ((normals * outwards).sum(1) > 0).all()


def test_landmarks_lie_where_they_should(head: HeadModel) -> None:
    """Canonical face mesh: 1 nose tip, 10 forehead, 152 chin, 33/263 outer eye corners."""
    points = head.landmarks(head.template)
    assert points.shape == (478, 3)
    nose, forehead, chin, right, left = points[[1, 10, 152, 33, 263]]
    assert nose[2] > max(forehead[2], chin[2], right[2], left[2])
    assert forehead[1] > right[1] > nose[1] > chin[1]
    assert 0.07 < left[0] - right[0] < 0.11
    np.testing.assert_allclose(left, right * FLIP, atol=1e-6)
    irises = head.region[head.faces[head.landmark_faces[468:]]]
    assert (irises == Region.EYES).all()
    np.testing.assert_allclose(head.landmark_bary.sum(1), 1, atol=1e-5)


def test_assets_hold_no_pickles() -> None:
    for name in ("open_head.npz", "open_hierarchy.npz"):
        with zipfile.ZipFile(ASSETS / name) as archive:
            assert all(entry.endswith(".npy") for entry in archive.namelist())
        with np.load(ASSETS / name, allow_pickle=False) as data:
            arrays = [data[key] for key in data.files]
        assert all(array.dtype.kind in "fiuU" for array in arrays)
        assert all(np.isfinite(a).all() for a in arrays if a.dtype.kind == "f")


def test_model_is_read_only(head: HeadModel) -> None:
    with pytest.raises(ValueError, match="read-only"):
        head.template[0] = 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e6])
def test_bad_numbers_are_refused(value: float) -> None:
    with pytest.raises(CoefficientsError):
        coefficients_of(np.full(100, value), np.zeros(50), np.zeros(15))


def test_broken_files_are_asset_errors(tmp_path: Path) -> None:
    with pytest.raises(AssetError):
        HeadModel.load(tmp_path / "missing.npz")
    whole = (ASSETS / "open_head.npz").read_bytes()
    for content in (b"", b"not a zip file", whole[: len(whole) // 2]):
        (tmp_path / "broken.npz").write_bytes(content)
        with pytest.raises(AssetError):
            HeadModel.load(tmp_path / "broken.npz")
    arrays = read_arrays(None, "open_head.npz")
    del arrays["weights"]
    np.savez(tmp_path / "partial.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(AssetError, match="weights"):
        HeadModel.load(tmp_path / "partial.npz")
    np.savez(tmp_path / "pickled.npz", template=np.array([{}], dtype=object))
    with pytest.raises(AssetError):
        HeadModel.load(tmp_path / "pickled.npz")


def test_hierarchy_belongs_to_the_head(head: HeadModel) -> None:
    hierarchy = MeshHierarchy.load()
    assert hierarchy.counts[0] == len(head.template)
    assert 400 < hierarchy.counts[2] < 500
    assert set(head.region[hierarchy.coarse].tolist()) == set(Region)
    for (indices, weights), down in zip(hierarchy.up, hierarchy.down, strict=True):
        np.testing.assert_allclose(weights.sum(1), 1, atol=1e-5)
        # A vertex that survives gets its own feature back.
        own = np.where(indices[down] == np.arange(len(down))[:, None], weights[down], 0)
        np.testing.assert_allclose(own.sum(1), 1, atol=1e-5)


def test_upsampling_approximates_the_template(head: HeadModel) -> None:
    hierarchy = MeshHierarchy.load()
    points = head.template[hierarchy.coarse]
    for indices, weights in reversed(hierarchy.up):
        points = (points[indices] * weights[..., None]).sum(1)
    assert np.linalg.norm(points - head.template, axis=1).mean() < 2e-3


def test_spirals_start_at_the_vertex_and_its_ring(head: HeadModel) -> None:
    spirals = MeshHierarchy.load().spirals[0]
    np.testing.assert_array_equal(spirals[:, 0], np.arange(len(head.template)))
    assert (np.sort(spirals, 1)[:, 1:] > np.sort(spirals, 1)[:, :-1]).all(), "repeated vertex"
    edges = {frozenset(e) for f in head.faces.tolist() for e in (f[:2], f[1:], f[::2])}
    assert all(frozenset(pair) in edges for pair in spirals[:, :2].tolist())
