"""Carrying the portrait to the driven points: geometry, on the real head."""

from __future__ import annotations

import numpy as np
import pytest

from cvthead import Avatar, Pipeline
from cvthead.head.model import Region
from cvthead.points import SEEN, SEEN_MIRRORED
from cvthead.runtime.ghosts import point_owners
from cvthead.runtime.place import place
from cvthead.runtime.triangles import FAR, rasterise
from cvthead.runtime.warp import dense_flow, warp

SIZE = 256
EMPTY = FAR - 0.1


def eye_box(points: np.ndarray, pipeline: Pipeline) -> tuple[slice, slice]:
    """Rows and columns of the subject's left eyeball in the picture."""
    head = pipeline.head
    left = (head.region == Region.EYES) & (head.template[:, 0] > 0)
    pixels = (points[: len(left)][left, :2] * 0.5 + 0.5) * SIZE
    (x0, y0), (x1, y1) = np.floor(pixels.min(0)).astype(int), np.ceil(pixels.max(0)).astype(int)
    return slice(y0, y1), slice(x0, x1)


def test_triangles_interpolate_at_pixel_centres() -> None:
    rng = np.random.default_rng(0)
    line = (np.arange(SIZE) + 0.5) * 2 / SIZE - 1
    errors = []
    for _ in range(40):
        corners = rng.uniform(-0.9, 0.9, (3, 3)).astype(np.float32)
        corners[:, 2] *= 0.1  # the head's own triangles span less
        values = np.concatenate([corners[:, :2] / 4 + 0.5, np.ones((3, 1))], 1).astype(np.float32)
        for order in ((0, 1, 2), (0, 2, 1)):
            image, depth = rasterise(corners, np.array([order], np.int32), values, SIZE)
            drawn = depth < EMPTY
            assert np.array_equal(drawn, image[..., 2] > 0)
            place = (image[..., :2] - 0.5) * 4
            errors.append((place[..., 0] - line)[drawn])
            errors.append((place[..., 1] - line[:, None])[drawn])
    off = np.concatenate(errors) * SIZE / 2
    assert abs(off.mean()) < 0.15  # pixels
    assert off.std() < 0.15


def test_only_front_faces_are_drawn_and_the_nearest_wins() -> None:
    near = np.array([[-0.5, -0.5, -0.1], [0.5, -0.5, -0.1], [0, 0.5, -0.1]], np.float32)
    points = np.concatenate([near, near + np.array([0, 0, 0.3], np.float32)])
    values = np.repeat(np.array([[0.2, 0.2, 1.0], [0.8, 0.8, 1.0]], np.float32), 3, axis=0)
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    turned = faces[:, ::-1].copy()
    drawn = [rasterise(points, f, values, 64) for f in (faces, turned)]
    covered = [float((depth < EMPTY).mean()) for _, depth in drawn]
    assert sorted(covered)[0] == 0
    assert sorted(covered)[1] == pytest.approx(0.125, abs=0.01)
    image, depth = drawn[int(np.argmax(covered))]
    assert np.allclose(image[depth < EMPTY][:, 0], 0.2, atol=1e-3)
    assert np.allclose(depth[depth < EMPTY], -0.1, atol=1e-3)


def test_at_its_own_pose_the_portrait_stays_where_it_is(pipeline: Pipeline, avatar: Avatar) -> None:
    points = pipeline.pose(avatar, avatar.coefficients, avatar.camera)
    placed = pipeline.place(avatar, points)
    rows, columns = eye_box(points, pipeline)
    for part in ((slice(None), slice(None)), (rows, columns)):
        # Where the portrait shows the person.
        shown = avatar.portrait[part][..., 3] > 250
        difference = np.abs(placed.warped[part].astype(int) - avatar.portrait[part])[shown]
        assert difference.mean() < 1.5


def test_eyes_turn_by_the_angle_asked_for(pipeline: Pipeline, avatar: Avatar) -> None:
    """The carried iris moves as far as the eyeball's front does, at full resolution."""
    shifts = []
    for angle in (-0.2, 0.2):
        pose = avatar.coefficients.with_joints(
            {"left_eye": (0, angle, 0), "right_eye": (0, angle, 0)}
        )
        points = pipeline.pose(avatar, pose, avatar.camera)
        rows, columns = eye_box(points, pipeline)
        dark = 255.0 - pipeline.place(avatar, points).warped[rows, columns, :3].mean(-1)
        dark = np.clip(dark - np.percentile(dark, 75), 0, None)
        shifts.append(float((dark.sum(0) * np.arange(dark.shape[1])).sum() / dark.sum()))
        front = points[: pipeline.layout.vertices][pipeline.head.region == Region.EYES]
        assert np.isfinite(front).all()
    assert shifts[1] - shifts[0] > 1.0  # pixels, to the subject's left


def test_hidden_half_comes_from_the_other_side(pipeline: Pipeline, avatar: Avatar) -> None:
    layout = pipeline.layout
    head = pipeline.head
    rows = avatar.exact_places.copy()
    rows[:, 2] = SEEN
    points = pipeline.pose(avatar, avatar.coefficients, avatar.camera)
    # Pretend that the subject's left half was not seen.
    left = np.zeros(len(rows), bool)
    left[: layout.vertices] = head.template[:, 0] > 0
    left[layout.vertices : layout.surface] = head.template[layout.edges, 0].mean(1) > 0
    part = eye_box(points, pipeline)
    portrait = avatar.portrait.copy()
    portrait[part] = 0
    shown = []
    for seen in (SEEN_MIRRORED, 0.0):
        rows[left, 2] = seen
        owners = point_owners(rows, rows[:, 2] == SEEN)
        codes = avatar.descriptors
        warped = place(layout, points, rows, owners, avatar.rim, codes, portrait, 128).warped
        shown.append(float(warped[part].mean()))
    assert shown[0] > 60
    assert shown[1] < 5


def test_dense_flow_keeps_what_is_known_and_fills_the_rest() -> None:
    flow = np.zeros((128, 128, 2), np.float32)
    flow[..., 0] = 0.25
    seen = (np.random.default_rng(0).random((128, 128)) > 0.7).astype(np.float32)
    seen[40:60, 30:70] = 0
    assert np.allclose(dense_flow(flow[..., 0], flow[..., 1], seen, SIZE), [0.25, 0], atol=1e-4)


def test_warp_reads_the_portrait_at_the_flow() -> None:
    portrait = np.random.default_rng(0).integers(0, 256, (SIZE, SIZE, 4), dtype=np.uint8)
    flow = np.zeros((SIZE, SIZE, 2), np.float32)
    assert np.array_equal(warp(portrait, flow), portrait)
    flow[..., 0] = 2 * 3 / SIZE
    assert np.array_equal(warp(portrait, flow)[:, :-3], portrait[:, 3:])
