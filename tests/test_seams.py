"""The portrait's outline, carried to within the person."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.avatar import Avatar
from cvthead.driving import at_neck
from cvthead.pipeline import Pipeline
from cvthead.runtime.fill import FILL_LEVELS
from cvthead.runtime.place import place
from cvthead.runtime.seams import RIM_PIXELS, outline_rim, seams

SIZE = 128


def disc(size: int, radius: float) -> NDArray[np.bool_]:
    middle = np.arange(size) + 0.5 - size / 2
    return np.asarray(np.hypot(middle[:, None], middle) < radius)


def test_the_rim_is_four_pixels_wide() -> None:
    portrait = np.full((256, 256, 4), 200, np.uint8)
    portrait[..., 3] = 255 * disc(256, 80)
    rim = outline_rim(portrait)
    assert rim.shape == (RIM_PIXELS, RIM_PIXELS)
    assert not rim[disc(RIM_PIXELS, 37)].any()
    assert (rim[~disc(RIM_PIXELS, 39)] == 1).all()


def test_unsure_segmentation_within_the_person_is_no_rim() -> None:
    portrait = np.full((256, 256, 4), 255, np.uint8)
    portrait[100:140, 100:140, 3] = 180
    assert not outline_rim(portrait).any()


def test_at_the_border_of_the_crop_there_is_no_rim() -> None:
    assert not outline_rim(np.full((256, 256, 4), 255, np.uint8)).any()


def test_a_rim_counts_deep_inside_the_person_alone() -> None:
    rim = np.zeros((RIM_PIXELS, RIM_PIXELS), np.float32)
    rim[:, 60:68] = 1
    covered = disc(SIZE, 40).astype(np.uint8)
    found = seams(np.zeros((SIZE, SIZE, 2), np.float32), rim, covered)
    assert (found[50:78, 60:68] == 1).all()
    assert not found[:, :58].any()
    assert not found[~disc(SIZE, 33)].any()
    moved = np.full((SIZE, SIZE, 2), 0.25, np.float32)
    moved[..., 1] = 0
    assert (seams(moved, rim, covered)[56:72, 44:52] == 1).all()  # by 16 pixels to the left


def test_a_turned_head_shows_nothing_of_what_was_behind_it(
    pipeline: Pipeline, avatar: Avatar
) -> None:
    """A portrait whose rim is painted green, turned far: no green deep within the points."""
    portrait = avatar.portrait.copy()
    green = (avatar.rim > 0.5).repeat(2, 0).repeat(2, 1) & (portrait[..., 3] > 0)
    portrait[green, :3] = 0, 255, 0
    shown = np.zeros(2)
    for yaw in (-0.9, 0.9):
        wanted = avatar.coefficients.with_joints({"global": (0, yaw, 0)})
        wanted, camera = at_neck(pipeline.head, avatar.coefficients, wanted, avatar.camera)
        points = pipeline.pose(avatar, wanted, camera)
        for number, rim in enumerate((np.zeros_like(avatar.rim), avatar.rim)):
            placed = place(
                pipeline.layout,
                points,
                avatar.exact_places,
                avatar.owners,
                rim,
                avatar.descriptors,
                portrait,
                SIZE,
            )
            drawn = (placed.codes[..., -FILL_LEVELS] > 0).astype(np.uint8)
            covered = cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
            deep = cv2.erode(covered, np.ones((21, 21), np.uint8)) > 0
            red, level, blue, alpha = np.moveaxis(placed.warped[::2, ::2].astype(int), 2, 0)
            seen = (level > 150) & (red < 100) & (blue < 100) & (alpha > 128)
            shown[number] += seen[deep].sum()
    assert shown[0] > 50
    assert shown[1] < 0.1 * shown[0]


def test_at_its_own_pose_a_portrait_keeps_its_rim(pipeline: Pipeline, avatar: Avatar) -> None:
    placed = pipeline.place(avatar, pipeline.pose(avatar, avatar.coefficients, avatar.camera))
    own = avatar.portrait[..., 3] > 128
    assert (placed.warped[..., 3] > 100)[own].mean() > 0.99
