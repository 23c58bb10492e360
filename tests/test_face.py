"""What the face's triangles cover: teeth and eyeballs do not shine through cheeks and lids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cvthead import Avatar, Pipeline
from cvthead.head.model import Region
from cvthead.points import FAR_AWAY, SEEN
from cvthead.runtime.face import carried_face, splatted, without_covered
from cvthead.runtime.splat import splat
from cvthead.runtime.triangles import FAR

SIZE = 256


def posed(pipeline: Pipeline, avatar: Avatar, *, yaw: float = 0.0, jaw: float = 0.0) -> np.ndarray:
    pose = avatar.coefficients.with_joints({"global": (0, yaw, 0), "jaw": (jaw, 0, 0)})
    return pipeline.pose(avatar, pose, avatar.camera)


def shown(pipeline: Pipeline, points: np.ndarray, region: Region) -> int:
    """Pixels of the splat that points of a region own."""
    owner = splat(points, SIZE // 2)
    owner = owner[(owner >= 0) & (owner < pipeline.layout.surface)]
    return int((pipeline.layout.region[owner] == region).sum())


@pytest.mark.parametrize("yaw", [-0.8, 0.8])
def test_teeth_do_not_shine_through_a_cheek(pipeline: Pipeline, avatar: Avatar, yaw: float) -> None:
    points = posed(pipeline, avatar, yaw=yaw)
    assert shown(pipeline, points, Region.MOUTH) > 10
    assert shown(pipeline, splatted(pipeline.layout, points, SIZE), Region.MOUTH) <= 3


def test_an_open_mouth_shows_teeth_and_tongue(pipeline: Pipeline, avatar: Avatar) -> None:
    opened, shut = (
        shown(
            pipeline,
            splatted(pipeline.layout, posed(pipeline, avatar, jaw=jaw), SIZE),
            Region.MOUTH,
        )
        for jaw in (0.35, 0.0)
    )
    assert opened > 20
    assert opened > 3 * shut


def test_the_face_and_what_stands_beside_it_stay(pipeline: Pipeline, avatar: Avatar) -> None:
    points = posed(pipeline, avatar)
    left = splatted(pipeline.layout, points, SIZE)
    gone = (left == FAR_AWAY).all(1) & (points != FAR_AWAY).any(1)
    region = pipeline.layout.region
    assert not gone[pipeline.layout.face].any()
    assert (left[~gone] == points[~gone]).all()
    for kind in (Region.SHOULDERS, Region.EARS):
        assert gone[: len(region)][region == kind].mean() < 0.2


def test_frames_are_placed_without_what_is_covered(pipeline: Pipeline, avatar: Avatar) -> None:
    layout = pipeline.layout
    marks = np.ones_like(avatar.descriptors)
    marks[: layout.surface][layout.region == Region.MOUTH] = 255
    marked = replace(avatar, descriptors=marks)
    points = posed(pipeline, avatar, yaw=0.8)
    placed = pipeline.place(marked, points)
    owner = splat(splatted(layout, points, SIZE), SIZE // 2)
    mouth = (owner >= 0) & (owner < layout.surface)
    mouth[mouth] = layout.region[owner[mouth]] == Region.MOUTH
    assert np.array_equal(placed.codes[owner >= 0][:, 1] == 255, mouth[owner >= 0])


def test_nothing_is_lent_to_an_open_mouth(pipeline: Pipeline, avatar: Avatar) -> None:
    """Its colours would be those of the lips around."""
    points = posed(pipeline, avatar, jaw=0.35)
    nowhere = avatar.places.copy()
    nowhere[:, 2] = 0
    lent = pipeline.place(replace(avatar, places=nowhere), points).lent
    layout = pipeline.layout
    owner = splat(splatted(layout, points, SIZE), SIZE // 2)
    mouth = (owner >= 0) & (owner < layout.surface)
    mouth[mouth] = layout.inner[owner[mouth]]
    assert mouth.sum() > 50
    assert lent[mouth].mean() < 0.6
    assert lent[~mouth].mean() > 0.95


def test_the_throat_is_never_shown(pipeline: Pipeline, avatar: Avatar) -> None:
    layout = pipeline.layout
    assert 0 < len(layout.throat) < (layout.region == Region.MOUTH).sum() / 2
    assert set(layout.mirror[layout.throat]) == set(layout.throat)
    points = posed(pipeline, avatar, jaw=0.35)
    nothing = np.full((SIZE, SIZE), FAR, np.float32)
    left = without_covered(layout, points, nothing)
    assert np.array_equal(np.flatnonzero((left != points).any(1)), layout.throat)


def test_points_beyond_the_frame_are_no_trouble(pipeline: Pipeline, avatar: Avatar) -> None:
    points = posed(pipeline, avatar) + np.array([5, -5, 0], np.float32)
    places = np.full_like(points, SEEN)
    face = carried_face(pipeline.layout, points, places, SIZE)
    assert not face.known.any()
    assert (face.depth >= FAR - 0.1).all()
    assert np.isfinite(without_covered(pipeline.layout, points, face.depth)).all()
