"""The fit of the landmarks' places finds known places back on made heads."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.head.model import HeadModel
from tools.fit_landmarks import fit, ground_of, makehuman_ids
from tools.landmark_start import laid_on, mean_face, mirror_pairs
from tools.landmarks import EMBEDDING, Floats, Ground, Ints
from tools.makehuman import BaseMesh

PORTRAITS = 16
UPPER_LIP, LOWER_LIP = 13, 14  # inner lip landmarks
JAW = 2
FLIP = np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.load()


@pytest.fixture(scope="module")
def ground(head: HeadModel) -> Ground:
    return ground_of(head, np.ones(len(head.template), bool))


@pytest.fixture(scope="module")
def portraits(head: HeadModel) -> Floats:
    """What a landmark network finds in pictures of different people, half with an open mouth."""
    rng = np.random.default_rng(0)
    camera = Camera(scale=1500.0, tx=0.3, ty=-0.3)
    found = []
    for number in range(PORTRAITS):
        pose = np.zeros(15)
        pose[:3] = rng.normal(0, 0.15, 3)
        pose[6] = 0.25 * (number % 2)
        codes = rng.normal(0, 0.3, 150)
        coefficients = Coefficients(
            *(np.asarray(x, np.float32) for x in (codes[:100], codes[100:], pose))
        )
        points = head.landmarks(head.vertices(coefficients)).astype(float)
        image = camera.project(points.astype(np.float32))[:, :2]
        depth = -camera.scale * points[:, 2]
        found.append(np.column_stack([image, depth]) + rng.normal(0, 0.5, (len(points), 3)))
    return np.array(found)


def stored_pairs() -> Ints:
    with np.load(EMBEDDING, allow_pickle=False) as data:
        return np.asarray(data["mirror"], np.int64)


def distance(head: HeadModel, points: NDArray[np.floating]) -> Floats:
    """(478,) millimetres from the places that the head carries."""
    return np.asarray(1000 * np.linalg.norm(points - head.landmarks(head.template), axis=1))


def test_shifted_places_are_found_back(head: HeadModel, ground: Ground, portraits: Floats) -> None:
    pair = stored_pairs()
    rng = np.random.default_rng(1)
    start = head.landmarks(head.template) + rng.normal(0, 0.002, (len(pair), 3))
    start[[UPPER_LIP, LOWER_LIP]] = start[[LOWER_LIP, UPPER_LIP]]
    sigma = np.zeros(len(pair))
    before = distance(head, ground.points(ground.place(start, pair, sigma)))
    found = fit(head, ground, portraits, start, pair)
    after = distance(head, ground.points(found))
    assert np.median(before) > 1.2
    assert np.median(after) < 0.5 * np.median(before)
    weights = head.weights[head.faces[found.faces], JAW]
    jaw = (found.barycentric * weights).sum(1)
    assert jaw[LOWER_LIP] > 0.9
    assert jaw[UPPER_LIP] < 0.1
    points = ground.points(found)
    np.testing.assert_allclose(points[pair], points * FLIP, atol=2e-5)
    np.testing.assert_allclose(found.barycentric.sum(1), 1, atol=1e-6)
    # Half a pixel of noise at 1500 pixels per metre is 0.5 mm in the plane.
    assert 2e-4 < np.median(found.sigma) < 1e-3


def test_the_mean_face_starts_near(head: HeadModel, ground: Ground, portraits: Floats) -> None:
    face = mean_face(portraits)
    pair = mirror_pairs(face)
    np.testing.assert_array_equal(pair, stored_pairs())
    points = ground.points(ground.place(laid_on(face, pair, ground), pair, np.zeros(len(pair))))
    assert np.median(distance(head, points)) < 3


def test_an_asymmetric_face_has_no_mirror_pairs(portraits: Floats) -> None:
    face = mean_face(portraits)
    face[:200] += np.linspace(0, 3, 200)[:, None]
    with pytest.raises(ValueError, match="symmetric"):
        mirror_pairs(face)


def test_texture_coordinates_name_makehumans_vertices(head: HeadModel) -> None:
    polygons = [
        (vertices, uvs)
        for vertices, uvs in zip((head.faces + 7).tolist(), head.uv_faces.tolist(), strict=True)
    ]
    known, hidden = polygons[:9000], polygons[9000:]
    groups = {"body": known, "helper-l-eye": [], "helper-r-eye": []}
    mesh = BaseMesh(np.zeros((0, 3)), head.uv.astype(float), groups)
    ids = makehuman_ids(head, mesh)
    seen = np.unique([v - 7 for vertices, _ in known for v in vertices])
    np.testing.assert_array_equal(ids[seen], seen + 7)
    unseen = np.setdiff1d([v - 7 for vertices, _ in hidden for v in vertices], seen)
    assert len(unseen)
    assert (ids[unseen] == -1).all()
