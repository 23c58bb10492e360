"""What the carried portrait must not show twice."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead import Avatar, Controls, Pipeline
from cvthead.driving import at_neck
from cvthead.runtime.fill import FILL_LEVELS
from cvthead.runtime.ghosts import OWNER_PIXELS, SURE, TOLERANCE, ghosts, point_owners
from cvthead.runtime.place import place, take_out

Array = NDArray[np.float32]

SIZE = 128


@pytest.fixture(scope="module")
def places() -> Array:
    """A grid of points, 6 pixels apart in 256, and one that nobody sees."""
    line = np.linspace(-0.98, 0.98, 42, dtype=np.float32)
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return np.concatenate([grid, np.array([[9, 9]], np.float32)])


@pytest.fixture(scope="module")
def owners(places: Array) -> NDArray[np.int32]:
    return point_owners(places, places[:, 0] < 9)


def centres() -> Array:
    line = (np.arange(SIZE, dtype=np.float32) + 0.5) * 2 / SIZE - 1
    return np.stack(np.meshgrid(line, line), axis=-1)


def test_each_pixel_belongs_to_the_nearest_point_that_is_seen() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-1.1, 1.1, (300, 2)).astype(np.float32)
    seen = rng.random(300) < 0.5
    owners = point_owners(places, seen)
    assert owners.shape == (OWNER_PIXELS, OWNER_PIXELS)
    assert seen[owners].all()
    # Points beyond the border stand on it.
    inside = places.clip(-1, 1)
    gap = np.linalg.norm(centres()[:, :, None] - inside[None, None], axis=-1)
    best = gap[..., seen].min(-1)
    own = np.take_along_axis(gap, owners[..., None].astype(np.int64), 2)[..., 0]
    assert (own - best).max() < 4 / SIZE  # two pixels, for points are rounded to pixels


def test_what_stays_or_moves_as_a_whole_is_no_ghost(
    places: Array, owners: NDArray[np.int32]
) -> None:
    covered = np.ones((SIZE, SIZE), np.bool_)
    for way in ((0, 0), (0.3, -0.2)):
        points = places + np.array(way, np.float32)
        flow = np.broadcast_to(-np.array(way, np.float32), (SIZE, SIZE, 2))
        # What comes from beyond the border belongs to nobody.
        known = np.abs(centres() + flow).max(-1) < 1
        assert not ghosts(flow, places - points, owners, covered)[known].any()


def test_what_was_left_behind_is_a_ghost(places: Array, owners: NDArray[np.int32]) -> None:
    """The right half moves up; the flow pretends that everything stayed."""
    points = places.copy()
    points[places[:, 0] > 0, 1] -= 0.2
    covered = np.ones((SIZE, SIZE), np.bool_)
    found = ghosts(np.zeros((SIZE, SIZE, 2), np.float32), places - points, owners, covered)
    assert not found[:, : SIZE // 2 - 3].any()
    assert (found[:, SIZE // 2 + 3 :] == 1).all()


def test_beside_the_points_less_is_forgiven(places: Array, owners: NDArray[np.int32]) -> None:
    points = places + np.array([0.05, 0], np.float32)
    still = np.zeros((SIZE, SIZE, 2), np.float32)
    covered = centres()[..., 0] < 0
    assert (ghosts(still, places - points, owners, covered) == ~covered).all()


def test_between_kept_and_gone_it_fades(places: Array, owners: NDArray[np.int32]) -> None:
    still = np.zeros((SIZE, SIZE, 2), np.float32)
    covered = np.ones((SIZE, SIZE), np.bool_)
    found = []
    for strayed in np.linspace(0.9, SURE + 0.1, 20) * TOLERANCE:
        points = places + np.array([strayed, 0], np.float32)
        found.append(float(ghosts(still, places - points, owners, covered).mean()))
    assert found[0] == 0
    assert found[-1] == 1
    assert 0 < max(np.diff(found)) < 0.2


@pytest.mark.parametrize("seen", [True, False])
def test_of_a_portrait_that_sees_nothing_or_everything_there_are_none(
    seen: bool, places: Array
) -> None:
    owners = point_owners(places, np.full(len(places), seen))
    assert (owners == -1).all()
    flow = np.ones((SIZE, SIZE, 2), np.float32)
    assert not ghosts(flow, np.zeros_like(places), owners, np.ones((SIZE, SIZE), np.bool_)).any()


def test_a_block_is_a_ghost_where_it_is_and_a_single_pixel_is_not(
    places: Array, owners: NDArray[np.int32]
) -> None:
    flow = np.zeros((SIZE, SIZE, 2), np.float32)
    flow[40:60, 70:90] = flow[10, 10] = 0.3
    found = ghosts(flow, np.zeros_like(places), owners, np.ones((SIZE, SIZE), np.bool_))
    assert (found[40:60, 70:90] == 1).all()
    assert found.sum() == 20 * 20


def test_a_block_is_taken_out_where_it_is() -> None:
    lost = np.zeros((SIZE, SIZE), np.float32)
    lost[40:60, 70:90] = 1
    warped = np.full((2 * SIZE, 2 * SIZE, 4), 200, np.uint8)
    kept = np.zeros((2 * SIZE, 2 * SIZE), np.bool_)
    kept[80:100] = True
    seam = np.zeros_like(lost)
    seam[45:50, 80:90] = 1
    take_out(warped, lost, seam, kept)
    gone = warped[..., 3] < 100
    assert gone[100:120, 140:180].all()
    assert gone[100:].sum() == 20 * 40
    assert tuple(warped[110, 150]) == (128, 128, 128, 0)
    assert gone[90:100, 160:180].all()  # a seam, even where no ghost may be
    assert (warped[80:100, :158] == 200).all()


def test_a_turned_head_has_no_second_outline(pipeline: Pipeline, avatar: Avatar) -> None:
    """Beside its points, a head turned far shows a fraction of what the flow would carry there."""
    shown = np.zeros(2)
    for yaw in (-0.9, 0.9):
        wanted = avatar.coefficients.with_joints({"global": (0, yaw, 0)})
        wanted, camera = at_neck(pipeline.head, avatar.coefficients, wanted, avatar.camera)
        points = pipeline.pose(avatar, wanted, camera)
        for number, owners in enumerate((np.full_like(avatar.owners, -1), avatar.owners)):
            placed = place(
                pipeline.layout,
                points,
                avatar.exact_places,
                owners,
                avatar.rim,
                avatar.descriptors,
                avatar.portrait,
                SIZE,
            )
            beside = placed.codes[..., -FILL_LEVELS] == 0  # of the finest coverage
            shown[number] += (placed.warped[::2, ::2, 3][beside] > 128).sum()
    assert shown[0] > 200
    assert shown[1] < shown[0] / 4


def test_at_its_own_pose_a_portrait_loses_nothing(pipeline: Pipeline, avatar: Avatar) -> None:
    frame = pipeline.render(avatar, Controls())
    placed = pipeline.place(avatar, pipeline.pose(avatar, avatar.coefficients, avatar.camera))
    lost = (placed.warped[..., 3] == 0) & (avatar.portrait[..., 3] > 250)
    assert lost.mean() < 0.001
    assert frame.alpha[avatar.portrait[..., 3] > 250].mean() > 240
