"""Which points have a colour of their own in the portrait."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead import Pipeline
from cvthead.clear import clear_points, doubtful_points, looks_like, own_colours
from cvthead.deformation import to_pixels
from cvthead.head.model import Region
from cvthead.source import Source

Array = NDArray[np.float32]

WALL = (-1.0, 1.0, -1.0)


def typical(pipeline: Pipeline, source: Source, region: Region) -> Array:
    """The colour in the middle of what is surely of this part."""
    layout = pipeline.layout
    colours = own_colours(source.network_input, source.points)[: layout.surface]
    own: Array = colours[source.clear[: layout.surface] & (layout.region == region)]
    return np.asarray(np.median(own, axis=0))


@pytest.mark.parametrize(
    ("colour", "believed"), [(WALL, False), (Region.FACE, True), (Region.SCALP, True)]
)
def test_what_is_seen_edge_on_must_look_like_the_person(
    colour: tuple[float, ...] | Region, believed: bool, pipeline: Pipeline, source: Source
) -> None:
    layout, image = pipeline.layout, source.network_input.copy()
    given = source.points, source.visible
    sure, doubtful = doubtful_points(layout, image, *given)
    assert doubtful.sum() > 100
    wanted = typical(pipeline, source, colour) if isinstance(colour, Region) else colour
    column, row = to_pixels(source.points[doubtful], image.shape[-1])[:, :2].astype(int).T
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            image[:3, row + down, column + right] = np.array(wanted, np.float32)[:, None]
    clear = clear_points(layout, image, *given)
    assert np.array_equal(clear[~doubtful], sure[~doubtful])
    assert clear[doubtful].all() if believed else not clear[doubtful].any()


def test_only_face_ears_and_neck_are_doubted(pipeline: Pipeline, source: Source) -> None:
    layout = pipeline.layout
    _, doubtful = doubtful_points(layout, source.network_input, source.points, source.visible)
    assert not doubtful[layout.surface :].any()
    parts = set(layout.region[doubtful[: layout.surface]].tolist())
    assert parts <= {Region.FACE, Region.EARS, Region.NECK}


def test_a_kind_is_told_by_most_of_its_colours() -> None:
    rng = np.random.default_rng(0)
    kind = rng.normal((0.5, 0, -0.5), 0.05, (200, 3)).astype(np.float32)
    kind[:30] = WALL
    assert looks_like(kind[30:], kind).mean() > 0.9
    assert not looks_like(kind[:30], kind).any()
