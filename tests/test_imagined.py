"""Training views that a portrait's points alone make up."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead import Pipeline
from cvthead.points import FAR_AWAY
from cvthead.source import Source, driven_points
from cvthead.training.imagined import LARGEST_YAW, NEAREST_YAW, imagined, turned

SIZE = 256


def view(
    pipeline: Pipeline, source: Source, points: NDArray[np.float32], image: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    drawn = np.where(source.drawn[:, None], points, FAR_AWAY)
    return imagined(
        pipeline.layout, image, source.head.mask, source.points, source.visible, drawn, SIZE
    )


def far(pipeline: Pipeline, source: Source, seed: int) -> NDArray[np.float32]:
    """Points of the source turned at random."""
    head = source.head
    rng = np.random.default_rng(seed)
    posed, camera = turned(rng, pipeline.head, head.coefficients, head.camera)
    return driven_points(pipeline.head, pipeline.layout, posed, source.deformation, camera)


@pytest.mark.parametrize("own", [-60.0, 0.0, 35.0])
def test_heads_turn_far_from_the_source_but_not_beyond_a_profile(
    own: float, pipeline: Pipeline, source: Source
) -> None:
    start = source.head.coefficients.with_joints({"global": (0, np.radians(own), 0)})
    rng = np.random.default_rng(0)
    found = []
    for _ in range(200):
        posed, _ = turned(rng, pipeline.head, start, source.head.camera)
        whole = np.degrees(posed.joint("global")[1] + posed.joint("neck")[1])
        found.append(float(whole))
    yaw = np.array(found)
    # Nodding mixes with turning by a degree or two.
    assert (np.abs(yaw) < LARGEST_YAW + 4).all()
    assert (np.abs(yaw - own) > NEAREST_YAW - 4).all()
    assert yaw.max() > LARGEST_YAW - 10
    if own - NEAREST_YAW > -LARGEST_YAW:
        assert yaw.min() < -LARGEST_YAW + 10


def test_at_its_own_pose_it_is_the_portrait(pipeline: Pipeline, source: Source) -> None:
    rgb, mask = view(pipeline, source, source.points, source.head.image)
    person = source.head.mask > 0.99
    assert np.abs(rgb - source.head.image / np.float32(255))[person].mean() < 0.01
    both = (mask > 0.5) & (source.head.mask > 0.5)
    either = (mask > 0.5) | (source.head.mask > 0.5)
    assert both.sum() / either.sum() > 0.97


@pytest.mark.parametrize("seed", range(4))
def test_a_person_of_one_colour_has_no_other(seed: int, pipeline: Pipeline, source: Source) -> None:
    """Neither the background, nor what the portrait holds beside the person, nor a guess."""
    image = np.zeros_like(source.head.image)
    image[source.head.mask > 0.02] = (200, 60, 120)
    rgb, mask = view(pipeline, source, far(pipeline, source, seed), image)
    inside = mask > 0.999
    assert inside.mean() > 0.15
    off = np.abs(rgb * 255 - np.array([200, 60, 120]))[inside].max(-1)
    assert (off < 8).mean() > 0.995
    assert np.median(off) < 2
