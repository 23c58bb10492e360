"""Tracker: recovery of known heads, photographs, refusals, smoothing, 68-point map, crop."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.crop import CROP_METRES, FACE_AT, head_crop
from cvthead.errors import FaceTooSmallError, ImageError, NoFaceError, SeveralFacesError
from cvthead.evaluation.tracking import read_image, track_clip
from cvthead.head.model import HeadModel, Region
from cvthead.tracking.landmarks68 import LANDMARKS_68, landmarks68
from cvthead.tracking.one_euro import FaceFilter, OneEuro, OneEuroState, one_euro
from cvthead.tracking.solver import Solver
from cvthead.tracking.tracker import Tracker

Image = NDArray[np.uint8]
CAMERA = Camera(scale=700.0, tx=0.31, ty=-0.22)
NOISE_PIXELS = 1.0


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return Tracker.load()


@pytest.fixture(scope="module")
def stills(shared: Path) -> list[Path]:
    """Every twelfth validation photograph."""
    return sorted((shared / "data" / "stills" / "val").glob("*.jpg"))[::12]


def posed_head(
    rng: np.random.Generator, yaw: float, jaw: float, gaze: tuple[float, float]
) -> Coefficients:
    """Random identity and expression with the given angles (radians)."""
    pose = np.zeros(15, np.float32)
    pose[:3] = rng.normal(0, 0.1), yaw, rng.normal(0, 0.1)
    pose[6] = jaw
    pose[9:11] = pose[12:14] = gaze
    codes = rng.normal(0, 0.3, 150).astype(np.float32)
    return Coefficients(codes[:100], codes[100:], pose)


def rendered_landmarks(
    head: HeadModel, coefficients: Coefficients, rng: np.random.Generator
) -> NDArray[np.float64]:
    """What a landmark network would find: projected landmarks with noise."""
    points = CAMERA.project(head.landmarks(head.vertices(coefficients))).astype(np.float64)
    return points + rng.normal(0, NOISE_PIXELS, points.shape)


def solved(
    solver: Solver, landmarks: NDArray[np.float64], shape: NDArray[np.float32] | None
) -> tuple[Coefficients, Camera]:
    start = solver.start(landmarks, shape)
    return solver.coefficients(
        solver.solve(landmarks, start, fit_shape=shape is None, iterations=10)
    )


def yaw_degrees(coefficients: Coefficients) -> float:
    rotation = cv2.Rodrigues(coefficients.joint("global").astype(np.float64))[0]
    return float(np.degrees(np.arctan2(rotation[0, 2], rotation[2, 2])))


@pytest.mark.parametrize("known_shape", [True, False])
@pytest.mark.parametrize("yaw", [-0.7, 0.0, 0.7])
@pytest.mark.parametrize("jaw", [0.0, 0.15, 0.35])
def test_angles_of_a_known_head_are_recovered(
    tracker: Tracker, yaw: float, jaw: float, known_shape: bool
) -> None:
    rng = np.random.default_rng(3)
    differences = []
    for gaze in ((0.0, 0.0), (0.2, 0.0), (-0.1, 0.25), (0.0, -0.3)):
        truth = posed_head(rng, yaw, jaw, gaze)
        landmarks = rendered_landmarks(tracker.head, truth, rng)
        found, _ = solved(tracker.solver, landmarks, truth.shape if known_shape else None)
        turn = yaw_degrees(found) - yaw_degrees(truth)
        angles = np.degrees(found.pose - truth.pose)[[6, 9, 10]]
        differences.append(np.array([turn, *angles]))
    errors = np.abs(differences).mean(axis=0)
    limits = np.array([1.0, 3.0, 5.0, 5.0])
    assert (errors < limits).all(), f"yaw, jaw, gaze pitch, gaze yaw: {errors} degrees"


def test_solved_head_projects_onto_the_landmarks(tracker: Tracker) -> None:
    """Ties the solver's own algebra to the HeadModel and Camera that everyone else uses."""
    rng = np.random.default_rng(5)
    truth = posed_head(rng, 0.4, 0.2, (0.1, 0.1))
    landmarks = rendered_landmarks(tracker.head, truth, rng)
    solver = tracker.solver
    fit = solver.solve(landmarks, solver.start(landmarks), fit_shape=True, iterations=10)
    coefficients, camera = solver.coefficients(fit)
    points = camera.project(tracker.head.landmarks(tracker.head.vertices(coefficients)))
    # Not exactly equal: the solver blends skinning weights over a triangle, the mesh its corners.
    difference = np.abs(points[:, :2] - solver.projected(fit))
    assert np.median(difference) < 1e-3
    assert difference.max() < 0.3
    distance = np.linalg.norm(points[:, :2] - landmarks[:, :2], axis=1)
    assert np.median(distance) < 2.5 * NOISE_PIXELS


def test_known_shape_is_kept(tracker: Tracker) -> None:
    rng = np.random.default_rng(6)
    truth = posed_head(rng, 0.1, 0.1, (0.0, 0.0))
    landmarks = rendered_landmarks(tracker.head, truth, rng)
    found, _ = solved(tracker.solver, landmarks, truth.shape)
    assert np.array_equal(found.shape, truth.shape)


def test_photographs(tracker: Tracker, stills: list[Path]) -> None:
    faces = [tracker.track(read_image(path)) for path in stills]
    assert np.median([face.error for face in faces]) < 1.3
    for face in faces:
        assert face.presence >= 0.5
        assert abs(face.coefficients.pose[3:6]).max() == 0
        assert np.abs(face.coefficients.shape).max() < 4
        left, top, right, bottom = face.box
        assert left < face.landmarks[1, 0] < right
        assert top < face.landmarks[1, 1] < bottom


def test_mirrored_photograph_gives_the_mirrored_pose(tracker: Tracker, stills: list[Path]) -> None:
    signs = np.array([1, -1, -1] * 5)
    for path in stills[:6]:
        image = read_image(path)
        pose = tracker.track(image).coefficients.pose
        mirrored = tracker.track(np.ascontiguousarray(image[:, ::-1])).coefficients.pose
        assert np.degrees(np.abs(mirrored * signs - pose))[[0, 1, 2, 6]].max() < 5


def test_shift_of_the_photograph_only_moves_the_camera(
    tracker: Tracker, stills: list[Path]
) -> None:
    image = read_image(stills[0])
    shifted = np.pad(image, ((40, 0), (80, 0), (0, 0)), mode="edge")
    first, second = tracker.track(image), tracker.track(shifted)
    moved = (second.camera.tx - first.camera.tx) * first.camera.scale
    assert moved == pytest.approx(80, abs=2)
    moved = (second.camera.ty - first.camera.ty) * first.camera.scale
    assert moved == pytest.approx(-40, abs=2)


def test_video_is_followed_without_loss(tracker: Tracker, shared: Path) -> None:
    clip = sorted((shared / "data" / "clips" / "val").glob("*.mp4"))[0]
    result = track_clip(tracker, clip, 20)
    assert result.frames == 20
    assert result.lost == 0
    assert result.error < 2.5


def test_face_that_left_its_place_is_found_again(tracker: Tracker, stills: list[Path]) -> None:
    image = read_image(stills[0])
    height, width = image.shape[:2]
    canvas = np.full((height, 3 * width, 3), 128, np.uint8)
    left, right = canvas.copy(), canvas.copy()
    left[:, :width], right[:, 2 * width :] = image, image
    before = tracker.track(left)
    after = tracker.track(right, previous=before)
    shift = (after.landmarks - before.landmarks)[:, 0]
    assert np.median(shift) == pytest.approx(2 * width, abs=0.02 * width)
    assert np.array_equal(after.coefficients.shape, before.coefficients.shape)


def resized(image: Image, side: int) -> Image:
    small = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
    return small.astype(np.uint8, copy=False)


@pytest.fixture(scope="module")
def group(stills: list[Path]) -> Image:
    """Three photographs side by side; the middle one is the largest."""
    heights = (300, 420, 240)
    tiles = []
    for path, height in zip(stills[-3:], heights, strict=True):
        tile = np.zeros((420, height, 3), np.uint8)
        tile[:height] = resized(read_image(path), height)
        tiles.append(tile)
    return np.concatenate(tiles, axis=1)


def test_several_faces_are_refused_or_chosen_by_size(tracker: Tracker, group: Image) -> None:
    with pytest.raises(SeveralFacesError) as caught:
        tracker.track(group, only_one=True)
    boxes = caught.value.boxes
    centres = [(left + right) / 2 for left, _, right, _ in boxes]
    assert [int(np.digitize(x, [300, 720])) for x in centres] == [1, 0, 2]
    for number, box in enumerate(boxes):
        assert tracker.track(group, face=number).box == pytest.approx(box, abs=1)
    assert tracker.track(group).box == pytest.approx(boxes[0], abs=1)
    with pytest.raises(NoFaceError):
        tracker.track(group, face=3)


def test_no_face(tracker: Tracker) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    with pytest.raises(NoFaceError) as caught:
        tracker.track(noise)
    assert caught.value.hint


def test_not_an_image(tracker: Tracker) -> None:
    with pytest.raises(ImageError):
        tracker.track(np.zeros((20, 20), np.uint8))


def test_small_face_cannot_become_an_avatar_but_can_drive(
    tracker: Tracker, stills: list[Path]
) -> None:
    image = resized(read_image(stills[0]), 80)
    with pytest.raises(FaceTooSmallError):
        tracker.track(image)
    assert tracker.track(image, shape=np.zeros(100, np.float32)).presence >= 0.5


def filtered(parameters: OneEuro, samples: NDArray[np.float64], fps: float) -> NDArray[np.float64]:
    state: OneEuroState | None = None
    values = []
    for index, sample in enumerate(samples):
        state = one_euro(parameters, state, sample, index / fps)
        values.append(state.value)
    return np.array(values)


def test_one_euro_passes_a_constant() -> None:
    samples = np.full((50, 3), [1.0, -2.0, 0.5])
    assert np.allclose(filtered(OneEuro(), samples, 25.0), samples)


def test_one_euro_reduces_jitter_of_a_still_head() -> None:
    samples = np.random.default_rng(1).normal(0, 0.02, (500, 4))
    assert filtered(OneEuro(), samples, 25.0)[50:].std() < 0.7 * samples.std()


def test_one_euro_does_not_lag_in_the_limit() -> None:
    ramp = np.linspace(0, 10, 200)[:, None]
    lags = [
        np.abs(filtered(OneEuro(speed_gain=gain), ramp, 25.0) - ramp)[-1, 0]
        for gain in (0.0, 2.0, 2e6)
    ]
    assert lags[0] > lags[1] > lags[2]
    assert lags[2] < 1e-3


def test_one_euro_ignores_a_repeated_time() -> None:
    first = one_euro(OneEuro(), None, np.zeros(2), 1.0)
    assert one_euro(OneEuro(), first, np.ones(2), 1.0) is first


def test_face_filter_is_exact_at_rest_and_follows_through_half_a_turn() -> None:
    rng = np.random.default_rng(2)
    base = posed_head(rng, 0.2, 0.1, (0.0, 0.1))
    face_filter = FaceFilter()
    for frame in range(5):
        smooth, camera, face_filter = face_filter.step(base, CAMERA, frame / 25)
    assert np.allclose(smooth.pose, base.pose, atol=1e-6)
    assert np.allclose(smooth.expression, base.expression, atol=1e-6)
    assert np.allclose([camera.scale, camera.tx, camera.ty], [CAMERA.scale, CAMERA.tx, CAMERA.ty])
    # An upside-down head: 179 degrees of roll one way is 181 the other way.
    face_filter = FaceFilter()
    for frame, roll in enumerate(np.radians([179.0, -179.0, 179.0, -179.0])):
        turned = base.with_joints({"global": [0.0, 0.0, roll]})
        smooth, _, face_filter = face_filter.step(turned, CAMERA, frame / 25)
        assert abs(np.cos(smooth.pose[2]) + 1) < 0.01


def test_68_landmarks_are_symmetric(tracker: Tracker) -> None:
    """Reversing left and right maps the mean head's 68 points onto themselves."""
    head = tracker.head
    points = landmarks68(head.landmarks(head.vertices(Coefficients.zeros())))
    # fmt: off
    swap = np.array([
        *range(16, -1, -1), *range(26, 16, -1), *range(27, 31), *range(35, 30, -1),
        45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40,
        54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65,
    ])
    # fmt: on
    assert np.abs(points[swap] * [-1, 1, 1] - points).max() < 0.003
    assert len(set(LANDMARKS_68.tolist())) == 68


def test_68_landmarks_lie_where_they_should(tracker: Tracker) -> None:
    head = tracker.head
    points = landmarks68(head.landmarks(head.vertices(Coefficients.zeros())))
    x, y, z = points.T
    # The jaw line ends beside the eyes, at the back of the face; the chin is its lowest point.
    jaw = points[:17]
    assert jaw[:, 0].argmin() in (0, 1)
    assert jaw[:, 0].argmax() in (15, 16)
    assert jaw[:, 1].argmin() == 8
    assert (jaw[[0, 16], 2] < z[17:].min()).all()
    assert np.abs(jaw[[0, 16], 1] - y[[36, 45]]).max() < 0.03
    assert z.argmax() == 30
    # Every contour runs as documented; the subject's right is at -x, on the image's left.
    assert (np.diff(x[17:27]) > 0).all()
    assert (np.diff(x[31:36]) > 0).all()
    assert (np.diff(y[27:31]) < 0).all()
    assert x[36] < x[39] < x[42] < x[45]
    assert y[37] > y[41]
    assert y[51] > y[62] >= y[66] > y[57]


def test_crop_is_metric_and_holds_the_face(tracker: Tracker) -> None:
    rng = np.random.default_rng(8)
    head = tracker.head
    for yaw in (-0.6, 0.0, 0.6):
        coefficients = posed_head(rng, yaw, 0.1, (0.0, 0.0))
        crop = head_crop(head, coefficients, CAMERA)
        assert crop.size == pytest.approx(CROP_METRES * CAMERA.scale)
        face = head.vertices(coefficients)[head.region == Region.FACE]
        points = CAMERA.project(face)[:, :2]
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        share = (centre - [crop.left, crop.top]) / crop.size
        assert share == pytest.approx(FACE_AT, abs=1e-4)
        normalised = CAMERA.in_crop(crop).project(face)[:, :2]
        assert np.abs(normalised).max() < 1
