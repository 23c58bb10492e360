"""The cheap path on the released weights and the sample portrait."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from onnxruntime import InferenceSession

from cvthead import Avatar, Controls, Pipeline
from cvthead.avatar import Avatar as AvatarType
from cvthead.cache import AvatarCache
from cvthead.coefficients import Coefficients
from cvthead.composite import Composer
from cvthead.errors import AvatarFileError, CoefficientsError, ModelChangedError, NoFaceError
from cvthead.images import read_image
from cvthead.runtime.model_folder import RECORD, packaged
from cvthead.source import cut_head

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
TURN = 0.35  # radians


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    return Pipeline.load()


@pytest.fixture(scope="module")
def portrait() -> NDArray[np.uint8]:
    return read_image(PORTRAIT)


@pytest.fixture(scope="module")
def avatar(pipeline: Pipeline, portrait: NDArray[np.uint8]) -> AvatarType:
    return pipeline.encode(portrait)


class Counted:
    """A session that also counts its runs."""

    def __init__(self, session: InferenceSession) -> None:
        self.session, self.count = session, 0

    def run(self, *arguments: Any) -> Any:
        self.count += 1
        return self.session.run(*arguments)


def test_second_render_of_an_id_runs_no_encoder(
    pipeline: Pipeline, portrait: NDArray[np.uint8], tmp_path: Path
) -> None:
    networks = pipeline.networks
    describe, paint = Counted(networks.describe_session), Counted(networks.paint_session)
    counted = replace(
        pipeline, networks=replace(networks, describe_session=describe, paint_session=paint)
    )
    cache = AvatarCache(tmp_path)
    key = cache.put(counted.encode(portrait)).id
    assert (describe.count, paint.count) == (1, 0)
    for jaw in (0.0, 0.2):
        stored = cache.get(key)
        assert isinstance(stored, Avatar)
        counted.render(stored, Controls(jaw=(jaw, 0, 0)))
    assert (describe.count, paint.count) == (1, 2)


def test_a_batch_equals_single_frames(pipeline: Pipeline, avatar: AvatarType) -> None:
    poses = [
        pipeline.pose(avatar, avatar.coefficients.with_joints({"global": (0, turn, 0)}), camera)
        for turn, camera in ((0.0, avatar.camera), (0.3, avatar.camera))
    ]
    single = [pipeline.paint(avatar, points) for points in poses]
    batch = pipeline.paint_many([(avatar, points) for points in poses])
    for one, other in zip(single, batch, strict=True):
        assert np.array_equal(one.rgb, other.rgb)
        assert np.array_equal(one.alpha, other.alpha)
    assert not np.array_equal(batch[0].rgb, batch[1].rgb)


def test_file_round_trip_renders_the_same_and_is_small(
    pipeline: Pipeline, avatar: AvatarType, tmp_path: Path
) -> None:
    path = tmp_path / "me.avatar"
    avatar.save(path)
    assert path.stat().st_size <= 1_000_000
    again = Avatar.load(path)
    controls = Controls(arkit={"jawOpen": 0.4}, global_rotation=(0, 0.2, 0))
    first, second = pipeline.render(avatar, controls), pipeline.render(again, controls)
    # Offsets are stored in half precision: a point may fall into the neighbouring pixel.
    difference = np.abs(first.over((255, 255, 255)).astype(int) - second.over((255, 255, 255)))
    assert difference.mean() < 0.5


def test_render_looks_like_the_portrait(
    pipeline: Pipeline, avatar: AvatarType, portrait: NDArray[np.uint8]
) -> None:
    frame = pipeline.render(avatar)
    own, _ = avatar.crop.cut(portrait)
    inside = frame.alpha > 200
    assert 0.2 < inside.mean() < 0.9
    error = np.abs(frame.rgb.astype(float) - own)[inside].mean() / 255
    copy_of_mean = np.abs(own[inside].mean(axis=0) - own)[inside].mean() / 255
    assert error < 0.5 * copy_of_mean


def tracked(pipeline: Pipeline, avatar: AvatarType, controls: Controls) -> Coefficients:
    """Coefficients found again in the rendered picture."""
    image = pipeline.render(avatar, controls).over((255, 255, 255))
    return pipeline.tracker.track(image, shape=avatar.coefficients.shape).coefficients


def test_rendered_pose_is_the_one_asked_for(pipeline: Pipeline, avatar: AvatarType) -> None:
    for turn in (-TURN, 0.0, TURN):
        found = tracked(pipeline, avatar, Controls(global_rotation=(0, turn, 0)))
        assert found.joint("global")[1] == pytest.approx(turn, abs=0.12)
    shut = tracked(pipeline, avatar, Controls(arkit={}))
    wide = tracked(pipeline, avatar, Controls(arkit={"jawOpen": 0.8}))
    assert wide.joint("jaw")[0] - shut.joint("jaw")[0] > 0.08


def test_absent_keeps_the_source_and_zero_means_zero(
    pipeline: Pipeline, avatar: AvatarType
) -> None:
    source = avatar.coefficients
    same = Controls(expression=source.expression, global_rotation=source.joint("global"))
    kept = pipeline.render(avatar)
    assert np.array_equal(kept.rgb, pipeline.render(avatar, same).rgb)
    assert np.array_equal(kept.rgb, pipeline.render(avatar, Controls(mode="relative")).rgb)
    zero = Controls(expression=np.zeros(50), jaw=np.zeros(3))
    explicit = replace(source, expression=np.zeros(50, np.float32)).with_joints({"jaw": (0, 0, 0)})
    expected = pipeline.render_coefficients(avatar, explicit, avatar.camera)
    assert np.array_equal(pipeline.render(avatar, zero).rgb, expected.rgb)
    assert not np.array_equal(kept.rgb, expected.rgb)


def test_relative_adds_to_the_source(pipeline: Pipeline, avatar: AvatarType) -> None:
    added = np.zeros(50, np.float32)
    added[0] = 1.5
    relative = pipeline.render(avatar, Controls(expression=added, mode="relative"))
    absolute = pipeline.render(avatar, Controls(expression=avatar.coefficients.expression + added))
    assert np.array_equal(relative.rgb, absolute.rgb)


def test_other_weights_are_refused(pipeline: Pipeline, avatar: AvatarType) -> None:
    with pytest.raises(ModelChangedError, match="0123456789abcdef"):
        pipeline.render(replace(avatar, fingerprint="0123456789abcdef"))


def test_forged_arrays_are_refused(pipeline: Pipeline, avatar: AvatarType) -> None:
    whole = avatar.deformation
    for forged in (
        replace(avatar, descriptors=avatar.descriptors[:-1]),
        replace(avatar, descriptors=avatar.descriptors[:, :-1]),
        # NumPy would broadcast it over all vertices.
        replace(avatar, deformation=replace(whole, offsets=whole.offsets[:1])),
        replace(avatar, deformation=replace(whole, offsets=whole.offsets[:-1])),
    ):
        with pytest.raises(AvatarFileError, match="expected"):
            pipeline.render(forged)
        # Another model's avatar may have any shape; its weights are what is wrong with it.
        with pytest.raises(ModelChangedError):
            pipeline.render(replace(forged, fingerprint="0123456789abcdef"))


def test_deformation_can_be_left_out(pipeline: Pipeline, portrait: NDArray[np.uint8]) -> None:
    bald = pipeline.encode(portrait, deform=False)
    assert not bald.deformation.offsets.any()
    assert len(bald.deformation.shell_anchor) == 0


def test_wrong_input_is_named(pipeline: Pipeline, avatar: AvatarType, tmp_path: Path) -> None:
    with pytest.raises(NoFaceError):
        pipeline.encode(np.full((200, 200, 3), 127, np.uint8))
    with pytest.raises(CoefficientsError, match="expression"):
        Controls(expression=[0.0] * 49)
    with pytest.raises(CoefficientsError, match="NaN"):
        Controls(jaw=(np.nan, 0, 0))
    with pytest.raises(CoefficientsError, match="noSuchUnit"):
        pipeline.render(avatar, Controls(arkit={"noSuchUnit": 0.5}))
    missing = tmp_path / "missing.avatar"
    with pytest.raises(AvatarFileError, match="does not exist"):
        Avatar.load(missing)
    missing.write_bytes(PORTRAIT.read_bytes())
    with pytest.raises(AvatarFileError):
        Avatar.load(missing)


def test_what_the_portrait_cuts_off_is_not_drawn(
    pipeline: Pipeline, portrait: NDArray[np.uint8]
) -> None:
    crop = pipeline.encode(portrait).crop
    chin = round(crop.top + 0.75 * crop.size)
    cut = pipeline.encode(portrait[:chin])
    whole = pipeline.encode(portrait)
    assert cut.drawn.mean() < whole.drawn.mean() - 0.03
    below = slice(round(256 * (chin + 12 - cut.crop.top) / cut.crop.size), None)
    assert pipeline.render(cut).alpha[below].mean() < 12
    assert pipeline.render(whole).alpha[below].mean() > 128


def test_what_is_nearly_sure_to_be_person_or_background_is_no_fog(
    pipeline: Pipeline, portrait: NDArray[np.uint8]
) -> None:
    head = cut_head(pipeline.tracker, portrait, pipeline.tracker.track(portrait))
    probability = pipeline.tracker.networks.person_mask(head.image)
    assert (head.mask[probability < 0.24] == 0).all()
    sure = head.mask[(probability > 0.76) & head.valid]
    assert np.isin(sure, (0, 1)).all()  # 0 for somebody else
    assert sure.mean() > 0.9
    unsure = (np.abs(probability - 0.5) < 0.2) & (head.mask > 0)
    assert unsure.any()
    np.testing.assert_array_equal(head.mask[unsure] > 0.5, probability[unsure] > 0.5)


def test_alpha_and_background(pipeline: Pipeline, avatar: AvatarType) -> None:
    frame = pipeline.render(avatar)
    red = frame.over((255, 0, 0))
    assert np.array_equal(
        red[frame.alpha == 0], np.tile([255, 0, 0], ((frame.alpha == 0).sum(), 1))
    )
    assert np.array_equal(red[frame.alpha == 255], frame.rgb[frame.alpha == 255])
    assert frame.rgba().shape == (256, 256, 4)
    assert pipeline.background(avatar).shape == (256, 256, 3)


def test_a_transparent_picture_keeps_the_colours_beside_the_person(
    pipeline: Pipeline, avatar: AvatarType
) -> None:
    frame = pipeline.render(avatar)
    composer = Composer.of("transparent", 256, pipeline.background(avatar))
    picture = composer.picture(frame)
    assert np.array_equal(picture[..., 3], frame.alpha)
    person = (frame.alpha > 0).astype(np.uint8)
    near = cv2.dilate(person, np.ones((3, 3), np.uint8)) > 0
    far = cv2.dilate(person, np.ones((9, 9), np.uint8)) == 0
    assert np.array_equal(picture[near][:, :3], frame.rgb[near])
    assert not picture[far].any()


def test_a_model_of_pixel_aligned_features_takes_every_point_as_seen(
    avatar: AvatarType, portrait: NDArray[np.uint8], tmp_path: Path
) -> None:
    """The ablation, told by what the export of a run writes into the model's record."""
    folder = tmp_path / "model"
    shutil.copytree(packaged("open"), folder)
    record = json.loads((folder / RECORD).read_text())
    record["training"]["features"] = "pixel-aligned"
    (folder / RECORD).write_text(json.dumps(record))
    ablation = Pipeline.load(model=folder).encode(portrait)
    assert (ablation.places[:, 2] == 1).all()
    assert {0, 1} < set(avatar.places[:, 2].tolist())
    assert np.array_equal(ablation.places[:, :2], avatar.places[:, :2])
