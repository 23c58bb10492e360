"""The parts of the measures that need no trained network."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.deformation import DeformationModel
from cvthead.errors import AssetError, InputError
from cvthead.evaluation.big_pose import DEGREES, SOURCES, big_pose_pairs
from cvthead.evaluation.big_pose import spread as spread_numbers
from cvthead.evaluation.cross_identity import Found, cross_table, pairs
from cvthead.evaluation.groups import ALL, Reconstruction, group_tables, read_stills
from cvthead.evaluation.identity import ARCFACE, Scale, arcface_crop, dlib_embedder, unit
from cvthead.evaluation.methods import COPY, MESH, baselines
from cvthead.evaluation.metrics import Score
from cvthead.evaluation.retracking import Errors, errors, landmark_pixels, medians, retrack
from cvthead.evaluation.shots import Shot, Take, angle, rotation, shoot
from cvthead.evaluation.steadiness import (
    STRETCH,
    Steadiness,
    change,
    face_pixels,
    steadiness_table,
    still,
    stillest,
    vector,
)
from cvthead.evaluation.unseen import HIDDEN, UNSEEN, regions, visibility
from cvthead.images import read_image
from cvthead.points import PointLayout
from cvthead.tracking.landmarks68 import landmarks68
from cvthead.tracking.tracker import TrackedFace, Tracker

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return Tracker.load()


@pytest.fixture(scope="module")
def deformer(tracker: Tracker) -> DeformationModel:
    return DeformationModel.from_head(tracker.head)


@pytest.fixture(scope="module")
def portrait(tracker: Tracker) -> Shot:
    shot = shoot(tracker, "astronaut", 0, read_image(PORTRAIT))
    assert shot is not None
    return shot


def turned(yaw: float, *, neck: float = 0.0) -> Coefficients:
    return Coefficients.zeros().with_joints(
        {"global": (0, np.radians(yaw), 0), "neck": (0, np.radians(neck), 0)}
    )


def facing(portrait: Shot, yaw: float) -> TrackedFace:
    return replace(portrait.face, coefficients=turned(yaw))


def test_the_angle_between_heads_counts_the_neck() -> None:
    assert angle(rotation(turned(-20)), rotation(turned(15))) == pytest.approx(35, abs=1e-3)
    assert angle(rotation(turned(10, neck=20)), rotation(turned(30))) == pytest.approx(0, abs=1e-3)


def test_big_pose_pairs_are_far_apart_both_ways(portrait: Shot) -> None:
    yaws = [-20.0, 0.0, 5.0, 15.0]
    faces: list[TrackedFace | None] = [facing(portrait, yaw) for yaw in yaws]
    take = Take("clip", [portrait.image] * 5, portrait)
    found = big_pose_pairs(take, [*faces, None])
    assert found.chosen == {0: [3], 3: [0]}
    assert found.found == 2


def test_big_pose_pairs_of_a_turning_clip_are_few_and_spread(portrait: Shot) -> None:
    yaws = np.linspace(-40, 40, 100)
    take = Take("clip", [portrait.image] * 100, portrait)
    found = big_pose_pairs(take, [facing(portrait, yaw) for yaw in yaws])
    assert len(found.chosen) == SOURCES
    for source, drivers in found.chosen.items():
        assert all(abs(yaws[source] - yaws[driver]) > DEGREES for driver in drivers)
    assert found.found > sum(map(len, found.chosen.values()))
    assert spread_numbers([3, 4, 5, 6, 7], 3) == [3, 5, 7]


def test_drivers_of_other_people_only_and_the_same_each_time() -> None:
    chosen = pairs("abcde", 2, 4)
    assert len(chosen) == len(set(chosen)) == 20
    assert all(driver // 2 != source for source, driver in chosen)
    assert chosen == pairs("abcde", 2, 4)
    assert pairs("a", 2, 4) == []
    assert len(pairs("ab", 2, 4)) == 4


def test_nobody_is_driven_by_another_clip_of_the_same_person() -> None:
    people = "aabca"
    chosen = pairs(people, 2, 4)
    assert len(chosen) == len(set(chosen)) == 20
    assert all(people[source] != people[driver // 2] for source, driver in chosen)
    assert pairs("aaa", 2, 4) == []


def test_normalised_similarity_is_0_for_strangers_and_1_for_the_same() -> None:
    people = [unit(np.array(one, float)) for one in ((1, 0), (1, 1), (1, -1))]
    scale = Scale.of([0.97, 0.98, 0.99], people)
    assert scale.different == pytest.approx(np.sqrt(0.5))
    assert scale.normalised(scale.different) == pytest.approx(0)
    assert scale.normalised(0.98) == pytest.approx(1)


def test_cross_table_counts_lost_results_and_says_what_is_absent() -> None:
    done: list[dict[str, Found | None]] = [
        {"A": Found(Errors(2, 1, 3, 0.1), None)},
        {"A": None},
        {"A": Found(Errors(4, 1, 3, 0.1), None)},
    ]
    table = cross_table(done, None)
    assert table.rows["A"] == pytest.approx((None, None, 3, 1, 3, 0.1, 1))
    assert "CSIM is absent" in table.caption
    scored = [{"A": Found(Errors(2, 1, 3, 0.1), 0.9)}]
    assert cross_table(scored, Scale(1.0, 0.8)).rows["A"][:2] == pytest.approx((0.5, 0.9))
    assert np.isnan(medians([]).pose)


def test_dlib_tells_people_apart(portrait: Shot) -> None:
    try:
        embed = dlib_embedder()
    except AssetError as error:
        pytest.skip(str(error))
    known = embed(portrait.image, portrait.face)
    assert np.linalg.norm(known) == pytest.approx(1)
    upside_down = embed(np.ascontiguousarray(portrait.image[::-1]), portrait.face)
    darker = embed((portrait.image * 0.8).astype(np.uint8), portrait.face)
    assert known @ darker > 0.97 > known @ upside_down


def test_arcface_crop_puts_the_face_in_place(tracker: Tracker, portrait: Shot) -> None:
    crop = arcface_crop(portrait.image, portrait.face)
    enlarged = np.kron(crop, np.ones((4, 4, 1), np.uint8))
    face = tracker.track(enlarged)
    points = landmarks68(face.landmarks)[:, :2] / 4
    eyes = np.stack([points[36:42].mean(0), points[42:48].mean(0)])
    assert np.abs(eyes - ARCFACE[:2]).max() < 6


def test_noise_is_what_a_slow_motion_leaves() -> None:
    """A steady turn and a steady camera move are motion; what is beside them is noise."""
    rng = np.random.default_rng(0)
    wobble = rng.normal(0, 0.01, 400)
    series = [
        (
            turned(0.05 * i).with_joints({"jaw": (0.2 + wobble[i], 0, 0)}),
            Camera(5 + 0.001 * i, 0, 0),
        )
        for i in range(400)
    ]
    kept = np.stack([vector(one) for one in still(series)])
    assert len(kept) == 398
    jaw, yaw, scale = kept[:, 50 + 6], kept[:, 50 + 1], kept[:, 65]
    assert jaw.std() == pytest.approx(0.01, rel=0.1)
    assert jaw.mean() == pytest.approx(0.2, abs=0.002)
    assert np.ptp(yaw) < 1e-5
    assert np.ptp(scale) < 1e-5


def test_the_stillest_stretch_has_every_face(portrait: Shot) -> None:
    def moved(pixels: float) -> TrackedFace:
        return replace(portrait.face, landmarks=portrait.face.landmarks + np.array((pixels, 0, 0)))

    restless: list[TrackedFace | None] = [moved(3.0 * (i % 2)) for i in range(20)]
    calm: list[TrackedFace | None] = [moved(0.1 * i) for i in range(STRETCH)]
    assert stillest([*restless, *calm]) == 20
    assert stillest([*calm[:-1], None, *calm[:-1]]) is None


def test_change_counts_inside_the_face_only(portrait: Shot) -> None:
    inside = face_pixels(portrait.face, portrait.head.crop)
    assert 0.05 < inside.mean() < 0.5
    first = np.zeros((256, 256, 3), np.uint8)
    second = first + np.uint8(255)
    second[inside] = 51
    assert change([first, second], inside) == pytest.approx(0.2)


def test_steadiness_is_compared_with_each_clips_own_video() -> None:
    done = [
        Steadiness(driver, {"A": jitter}, {"A": flicker})
        for driver, jitter, flicker in ((0.01, 0.01, 0.005), (0.02, 0.03, 0.03), (0.1, 0.1, 0.1))
    ]
    rows = steadiness_table(done).rows
    assert rows["A"][2:] == pytest.approx((1, 1, 2 / 3))
    assert rows["driving video"][0] == pytest.approx(0.13 / 3)


def test_what_was_asked_is_where_the_face_is(tracker: Tracker, portrait: Shot) -> None:
    """The driver's own picture shows what the driver asks for, up to the fit."""
    shape = portrait.face.coefficients.shape
    person = baselines(DeformationModel.from_head(tracker.head))[COPY](portrait)
    got = retrack(tracker, person.follow(portrait), shape)
    assert got is not None
    found = errors(tracker, shape, portrait, got)
    assert found.pose < 3
    assert found.jaw < 3
    assert found.landmarks < 4
    assert found.expression < 0.05
    crop = portrait.head.crop
    pixels = (portrait.face.landmarks[:, :2] - (crop.left, crop.top)) * (256 / crop.size)
    asked = landmark_pixels(tracker, portrait.face.coefficients, portrait)
    assert np.linalg.norm(asked - pixels, axis=1).mean() < 2


def test_a_turned_result_is_found_turned(
    tracker: Tracker, deformer: DeformationModel, portrait: Shot
) -> None:
    person = baselines(deformer)[MESH](portrait)
    shape = portrait.face.coefficients.shape
    faces = [retrack(tracker, person.turned(yaw), shape) for yaw in (-30, 0, 30)]
    yaws = [face.yaw for face in faces if face is not None]
    assert len(yaws) == 3
    assert all(20 < after - before < 40 for before, after in pairwise(yaws))


def test_turning_the_head_shows_what_the_source_did_not(
    tracker: Tracker, deformer: DeformationModel, portrait: Shot
) -> None:
    visible = visibility(deformer, PointLayout.of(tracker.head))(portrait)
    everybody = replace(
        portrait.head, mask=np.ones((256, 256), np.float32), valid=np.ones((256, 256), bool)
    )
    driver = replace(portrait, head=everybody)
    shares = []
    for yaw in (0.0, 40.0):
        found = regions(visible.turned(yaw), driver)
        assert not (found[HIDDEN] & ~found[UNSEEN]).any()
        shares.append(found[HIDDEN].mean())
    assert shares[0] < 0.05
    assert shares[1] > 2 * shares[0]
    nobody = replace(driver, head=replace(everybody, mask=np.zeros((256, 256), np.float32)))
    assert not regions(visible.turned(0), nobody)[UNSEEN].any()


def test_stills_without_a_label_go_by_their_set(tmp_path: Path) -> None:
    (tmp_path / "stills.csv").write_text(
        "file,split,set,group\na.jpg,val,x,female/asian\nb.jpg,val,y,\nc.jpg,train,x,male/asian\n"
    )
    found = read_stills(tmp_path)
    assert [(still.path.name, still.group) for still in found] == [
        ("a.jpg", "female/asian"),
        ("b.jpg", "y"),
    ]
    assert read_stills(tmp_path / "nowhere") == []
    (tmp_path / "stills.csv").write_text("file,set\na.jpg,x\n")
    with pytest.raises(InputError, match="no table of stills"):
        read_stills(tmp_path)


def test_groups_have_a_row_each_and_one_over_all() -> None:
    done = [
        Reconstruction(group, {"A": Score(0, same, 0.1, 1)}, {"A": Score(0, same / 2, 0.2, 1)})
        for group, same in (("x", 30.0), ("x", 40.0), ("y", 20.0))
    ]
    (table,) = group_tables(done, 4)
    assert table.rows["x"][:2] == pytest.approx((2, 35))
    assert table.rows[ALL][:2] == pytest.approx((3, 30))
    assert table.rows[ALL][4] == pytest.approx(15)
    assert "3 of 4 stills" in table.caption


def test_frames_are_spread_after_the_source(portrait: Shot) -> None:
    take = Take("clip", [portrait.image] * 21, replace(portrait, number=4))
    assert take.spread(4) == [8, 12, 16, 20]
    assert Take("clip", [portrait.image], portrait).spread(3) == []
