"""Retraining the official network on a made-up import: records, samples, run, model folder."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import made_official
import numpy as np
import pytest
import torch
from made_loss_networks import made_vgg
from made_records import make_records
from pydantic import ValidationError
from safetensors.torch import load_file

from cvthead.camera import CROP_PIXELS
from cvthead.cli.main import main
from cvthead.errors import InputError
from cvthead.images import read_image
from cvthead.official.manifest import HAIR_ONNX, NETWORK, Manifest
from cvthead.official.networks import picture_array
from cvthead.official.pipeline import OfficialPipeline
from cvthead.official.retrained import RETRAINED
from cvthead.official.tables import OfficialTables
from cvthead.training.checkpoint import averaged, read
from cvthead.training.config import TrainConfig, load_config
from cvthead.training.dataset import VIEWS
from cvthead.training.export import averaged_model
from cvthead.training.official_dataset import OfficialPairDataset
from cvthead.training.official_records import OfficialFrame, official_records, stored_frame
from cvthead.training.renderers import paper_renderer, training_parts
from cvthead.training.train import train
from cvthead.video_writer import video_writer

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
FRAMES = 6
VERTICES = 5023
STEPS, RATE = 2, 1e-4
SMALL = (f"steps={STEPS}", "size=64", "batch=1", "workers=1", "log_every=1", "average=0.5")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def model(official_folder: Path) -> Path:
    return official_folder / "model"


@pytest.fixture(scope="module")
def out(model: Path, vgg: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command makes of a video in which the head tilts, and of a still: two steps."""
    base = tmp_path_factory.mktemp("official_training")
    (base / "videos").mkdir()
    image = read_image(PORTRAIT)
    size = image.shape[1], image.shape[0]
    with video_writer(base / "videos" / "tilting.mp4", size=size, fps=25) as write:
        for number in range(FRAMES):
            turn = cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), 4.0 * number - 8, 1)
            turned = cv2.warpAffine(image, turn, size, borderMode=cv2.BORDER_REPLICATE)
            write(turned.astype(np.uint8))
    cv2.imwrite(str(base / "videos" / "still.png"), image[..., ::-1])
    command = ["finetune", str(base / "videos"), str(base / "out"), "--preset", "official"]
    settings = [*SMALL, f"model={model}", f"networks.perceptual={vgg}"]
    chosen = [word for setting in settings for word in ("--set", setting)]
    assert main([*command, "--processes", "1", *chosen]) == 0
    return base / "out"


@pytest.fixture(scope="module")
def data(out: Path) -> Path:
    return out / "data"


@pytest.fixture(scope="module")
def run(out: Path) -> Path:
    return out / "run" / "checkpoint.pt"


@pytest.fixture(scope="module")
def vgg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_vgg(tmp_path_factory.mktemp("vgg") / "vgg.pth", "VGG-16")


def configured(data: Path, model: Path, vgg: Path, run: Path, **changes: Any) -> TrainConfig:
    """The shipped configuration of the paper, for seconds."""
    small = {
        "preset": "official",
        "model": str(model),
        "data": str(data / "train"),
        "run": str(run),
        "size": 64,
        "steps": 1,
        "batch": 1,
        "workers": 0,
        "average": 0.5,
        "losses": {"identity": 0.0},
        "networks": {"perceptual": str(vgg), "identity": None},
    }
    return load_config("paper", small | changes)


def samples(data: Path, model: Path, size: int, **options: Any) -> OfficialPairDataset:
    tables = OfficialTables.load(model)
    return OfficialPairDataset(data / "train", tables, size=size, seed=1, samples=8, **options)


def test_a_record_holds_what_encoding_asks_the_networks(data: Path, model: Path) -> None:
    report = json.loads((data / "report.json").read_text())
    assert report["dropped"] == {"a still": 1}
    assert report["kept"]["train"] == {"records": 1, "frames": FRAMES, "identities": 1}
    (stored,) = official_records(data / "train", Manifest.load(model).tables_fingerprint)
    assert stored.frames == FRAMES
    pipeline, tables = OfficialPipeline.load(model, threads=1), OfficialTables.load(model)
    arrays = stored.arrays()
    frames = [stored_frame(arrays, number) for number in range(FRAMES)]
    assert len({frame.square for frame in frames}) > 1
    for frame in frames[:2]:
        assert np.isin(frame.mask, (0, 1)).all()
        assert 0 < frame.mask.mean() <= 1
        # The pictures are stored as JPEG, which DECA and the hair model hardly notice.
        found = pipeline.tracker.estimate(frame.image, frame.square)
        assert np.abs(found.coefficients.shape - frame.coefficients.shape).max() < 0.1
        camera = frame.square.camera(found.cam)
        assert camera.scale == pytest.approx(frame.camera.scale, rel=0.02)
        array = (frame.image.transpose(2, 0, 1)[None] / np.float32(127.5) - 1).astype(np.float32)
        assert np.allclose(tables.offsets(frame.hair), pipeline.offsets(array), atol=1e-3)


def test_a_sample_projects_as_the_pipeline_does(data: Path, model: Path) -> None:
    dataset = samples(data, model, CROP_PIXELS)
    source, driver = two_frames(dataset)
    pipeline = OfficialPipeline.load(model, precision="float32", threads=1)
    offsets = dataset.tables.offsets(source.hair)
    avatar = replace(made_official.avatar(), offsets=offsets, fingerprint=pipeline.fingerprint)
    posed = replace(driver.coefficients, shape=source.coefficients.shape)
    expected = pipeline.pose(avatar, posed, driver.camera, driver.square)
    assert np.allclose(dataset.points(source, driver), expected, atol=1e-5)
    assert np.abs(dataset.points(source, source) - expected).max() > 1e-2
    assert np.abs(dataset.points(driver, driver) - expected).max() > 1e-3  # shape and hair


def test_points_lie_where_the_released_code_puts_them(data: Path, model: Path) -> None:
    """Step by step as it does: into the crop that DECA saw, to pixels, back by the similarity."""
    dataset = samples(data, model, CROP_PIXELS)
    frame, _ = two_frames(dataset)
    estimate = OfficialPipeline.load(model, threads=1).tracker.estimate(frame.image, frame.square)
    camera = frame.square.camera(estimate.cam)
    found = replace(frame, coefficients=estimate.coefficients, camera=camera)
    tables = dataset.tables
    vertices = tables.head.vertices(found.coefficients) + tables.offsets(found.hair)
    scale, x, y = estimate.cam.tolist()
    in_crop = scale * (vertices + np.array([x, y, 0])) * [1, -1, -1]
    pixels = (0.5 * in_crop[:, :2] + 0.5) * 224
    homogeneous = np.concatenate([pixels, np.ones((VERTICES, 1))], axis=1)
    picture = homogeneous @ np.linalg.inv(frame.square.tform.astype(np.float64)).T
    expected = np.concatenate([picture[:, :2] / 128 - 1, in_crop[:, 2:]], axis=1)
    assert np.allclose(dataset.points(found, found), expected, atol=1e-4)


def two_frames(dataset: OfficialPairDataset) -> tuple[OfficialFrame, OfficialFrame]:
    arrays = dataset.stored[0].arrays()
    return stored_frame(arrays, 0), stored_frame(arrays, 3)


def test_samples_are_frames_of_one_video(data: Path, model: Path) -> None:
    dataset = samples(data, model, 64)
    first, again, other = dataset[1], dataset[1], dataset[2]
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["background"], other["background"])
    assert first["source"].shape == (4, CROP_PIXELS, CROP_PIXELS)
    assert first["driven"].shape == (VIEWS, VERTICES, 3)
    assert first["image"].shape == (VIEWS, 3, 64, 64)
    arrays = dataset.stored[0].arrays()
    # The encoder sees the picture over its own background.
    pictures = [picture_array(stored_frame(arrays, number).image)[0] for number in range(FRAMES)]
    assert any(np.array_equal(first["source"][:3], picture) for picture in pictures)
    for number in range(len(dataset)):
        sample = dataset[number]
        assert not torch.equal(sample["driven"][0], sample["driven"][1])
        assert all(not torch.equal(sample["points"], driven) for driven in sample["driven"])
    bald = samples(data, model, 64, deform=False)[1]
    assert not torch.equal(bald["points"], first["points"])
    assert torch.equal(bald["image"], first["image"])


def test_a_run_begins_with_the_imported_weights_and_changes_them(
    data: Path, model: Path, vgg: Path, run: Path
) -> None:
    _, renderer = training_parts(configured(data, model, vgg, run.parent))
    contents = read(run)
    assert contents["step"] == STEPS
    losses = [json.loads(line) for line in (run.parent / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in losses] == [1, 2]
    assert all(np.isfinite(list(line.values())).all() for line in losses)
    imported = load_file(model / NETWORK)
    trained = contents["model"]
    assert trained.keys() == imported.keys() == renderer.model.state_dict().keys()
    learnt = {name for name, _ in renderer.model.named_parameters()}
    for name in learnt:
        assert (trained[name] - imported[name]).abs().max() <= STEPS * RATE * 1.01, name
    assert any(not torch.equal(trained[name], imported[name]) for name in learnt)


def test_a_run_becomes_a_model_of_the_preset(model: Path, out: Path, run: Path) -> None:
    folder = out / "model"
    before, after = Manifest.load(model), Manifest.load(folder)
    assert before.fingerprint != after.fingerprint
    assert after.sources[:-1] == before.sources
    assert after.sources[-1].used_for == (RETRAINED,)
    network = paper_renderer("fused", OfficialTables.load(model).hierarchy).model.eval()
    network.load_state_dict(averaged(read(run)))
    pipeline = OfficialPipeline.load(folder, precision="float32", threads=1)
    avatar = pipeline.encode(read_image(PORTRAIT))
    points = pipeline.pose(avatar, avatar.coefficients, avatar.camera)
    driven, descriptors = (torch.from_numpy(each[None]) for each in (points, avatar.descriptors))
    with torch.inference_mode():
        rgb, _ = network.paint(driven, descriptors, CROP_PIXELS)
    painted = ((rgb[0].permute(1, 2, 0).numpy() + 1) * 127.5).round()
    assert np.abs(painted - pipeline.render(avatar).rgb.astype(int)).max() <= 1


def test_presets_do_not_mix(
    data: Path,
    model: Path,
    vgg: Path,
    run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    make_records(tmp_path)
    tables = Manifest.load(model).tables_fingerprint
    with pytest.raises(InputError, match="records of the open preset"):
        official_records(tmp_path, tables)
    with pytest.raises(InputError, match=f"records of the import {tables}"):
        official_records(data / "train", "0" * 16)
    for path in (data / "train").iterdir():
        shutil.copy(path, tmp_path)
    with pytest.raises(InputError, match="records of the preset official"):
        training_parts(TrainConfig(data=tmp_path, steps=1))
    with pytest.raises(InputError, match="records of the open preset"):
        official_records(tmp_path, tables)
    with pytest.raises(InputError, match="is not exported by this"):
        averaged_model(read(run))
    with pytest.raises(InputError, match="model is for the preset official"):
        configured(data, model, vgg, tmp_path, preset="paper")
    with pytest.raises(ValidationError, match="imported weights are of the preset official"):
        TrainConfig(init="imported", steps=1)
    with pytest.raises(InputError, match="has no ablation"):
        configured(data, model, vgg, tmp_path, features="pixel-aligned", init="imported")
    shipped = configured(data, model, vgg, tmp_path / "run", init="shipped")
    with pytest.raises(InputError, match="holds another network"):
        train(shipped)
    folders = [str(data), str(tmp_path / "out")]
    assert main(["data", "prepare", *folders, "--model", str(model)]) == 2
    assert "--model goes with --preset official" in capsys.readouterr().err
    assert main(["finetune", *folders, "--set", "preset=official"]) == 2
    assert "add --preset official" in capsys.readouterr().err


def test_a_damaged_import_is_said_by_the_process_that_finds_it(
    model: Path, out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = tmp_path / "model"
    damaged.mkdir()
    for path in model.iterdir():
        (damaged / path.name).symlink_to(path)
    (damaged / HAIR_ONNX).unlink()
    command = ["data", "prepare", str(out.parent / "videos"), str(tmp_path / "out")]
    command += ["--preset", "official", "--model", str(damaged), "--processes", "1"]
    assert main(command) == 2
    assert f"{HAIR_ONNX} is missing" in capsys.readouterr().err


def test_the_ablation_becomes_a_model_too(
    data: Path,
    model: Path,
    vgg: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Trained in the second stage, in two sittings."""
    losses = {"identity": 0.0, "adversarial": 0.1, "feature_matching": 1.0}
    changes = {"features": "pixel-aligned", "deformation": False, "stage": 2, "steps": 2}
    config = configured(data, model, vgg, tmp_path / "run", losses=losses, **changes)
    train(config, sitting=1)
    checkpoint = train(config)
    assert read(checkpoint)["step"] == 2
    folder = tmp_path / "model"
    command = ["export-official", str(checkpoint), str(folder), "--precision", "float32"]
    assert main([*command, "--model", str(model)]) == 0
    assert capsys.readouterr().out.strip() == str(folder)
    for other, said in ((model, "already there"), (folder, "is the import itself")):
        assert main([*command, "--model", str(other)]) == 2
        assert said in capsys.readouterr().err
    pipeline = OfficialPipeline.load(folder, threads=1)
    avatar = pipeline.encode(read_image(PORTRAIT))
    assert not avatar.offsets.any()
    assert pipeline.render(avatar).rgb.std() > 0
