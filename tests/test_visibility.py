"""Which points a portrait sees."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead import Pipeline
from cvthead.head.mesh import edges
from cvthead.head.model import Region
from cvthead.points import PointLayout
from cvthead.source import Source
from cvthead.visibility import agreed


@pytest.fixture(scope="module")
def layout(pipeline: Pipeline) -> PointLayout:
    return pipeline.layout


def lonely(faces: NDArray[np.int32], own: NDArray[np.bool_]) -> int:
    """Vertices whose neighbours all answer otherwise."""
    one, other = edges(faces).T
    differs = own[one] != own[other]
    count = len(own)
    ends = np.concatenate([one, other])
    disagreeing = np.bincount(ends, np.concatenate([differs, differs]), count)
    return int(((disagreeing == np.bincount(ends, minlength=count)) & (disagreeing > 0)).sum())


def test_single_vertices_follow_their_neighbours(pipeline: Pipeline, layout: PointLayout) -> None:
    faces, count = pipeline.head.faces, layout.vertices
    left = pipeline.head.template[:, 0] > 0
    clean = np.zeros(layout.total, np.bool_)
    clean[:count] = left
    clean[count : layout.surface] = left[layout.edges].all(1)
    specked = clean.copy()
    rng = np.random.default_rng(0)
    flipped = rng.choice(layout.surface, 150, replace=False)
    specked[flipped] ^= True
    assert lonely(faces, specked[:count]) > 20
    found = agreed(layout, specked)
    assert lonely(faces, found[:count]) < 5
    # The border between the halves stays where it is, give or take a vertex.
    assert (found != clean)[: layout.surface].mean() < 0.01
    assert (found[:count] == left)[np.abs(pipeline.head.template[:, 0]) > 0.015].mean() > 0.999


def test_nothing_faint_is_kept_far_from_the_person(pipeline: Pipeline, source: Source) -> None:
    """At the lower border of the portrait the segmentation is unsure of the ground."""
    crop = source.head
    unsure = pipeline.tracker.networks.person_mask(crop.image)
    away = cv2.dilate((crop.mask > 0.5).astype(np.uint8), np.ones((31, 31), np.uint8)) == 0
    assert (unsure[away] > 0.1).any()
    assert not crop.mask[away].any()


def test_shell_points_have_no_neighbours(pipeline: Pipeline, layout: PointLayout) -> None:
    visible = np.random.default_rng(0).random(layout.total) < 0.5
    found = agreed(layout, visible)
    assert (found[layout.surface :] == visible[layout.surface :]).all()


def test_a_portrait_sees_the_face_and_not_the_back_of_the_head(
    pipeline: Pipeline, source: Source
) -> None:
    own = source.visible[: pipeline.layout.vertices]
    head = pipeline.head
    assert own[head.region == Region.FACE].mean() > 0.8  # lids and lips hide some
    back = (head.region == Region.SCALP) & (head.template[:, 2] < -0.05)
    assert back.any()
    assert own[back].mean() < 0.1
    assert lonely(head.faces, own) < 10
