"""Retraining the official network on a made-up import: records, samples, run, model folder."""

from __future__ import annotations

import json
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
from safetensors.torch import load_file

from cvthead.camera import CROP_PIXELS
from cvthead.cli.main import main
from cvthead.errors import InputError
from cvthead.images import read_image
from cvthead.official import retrained
from cvthead.official.manifest import NETWORK, Manifest
from cvthead.official.pipeline import OfficialPipeline
from cvthead.official.tables import OfficialTables
from cvthead.training.checkpoint import averaged, read
from cvthead.training.config import TrainConfig, load_config
from cvthead.training.dataset import VIEWS
from cvthead.training.export import averaged_model
from cvthead.training.official_dataset import OfficialPairDataset
from cvthead.training.official_records import OfficialRecord, official_records
from cvthead.training.renderers import paper_renderer, training_parts
from cvthead.training.train import train
from cvthead.video_writer import video_writer

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
FRAMES = 6
VERTICES = 5023
STEPS, RATE = 2, 1e-4
SMALL = (f"steps={STEPS}", "size=64", "batch=1", "workers=0", "log_every=1", "average=0.5")

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
    return OfficialPairDataset(data / "train", tables, size=size, seed=1, samples=4, **options)


def test_a_record_holds_what_encoding_asks_the_networks(data: Path, model: Path) -> None:
    report = json.loads((data / "report.json").read_text())
    assert report["dropped"] == {"a still": 1}
    assert report["kept"]["train"] == {"records": 1, "frames": FRAMES, "identities": 1}
    (stored,) = official_records(data / "train")
    assert stored.frames == FRAMES
    pipeline, tables = OfficialPipeline.load(model, threads=1), OfficialTables.load(model)
    record = OfficialRecord(stored.arrays())
    frames = [record.frame(number) for number in range(FRAMES)]
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
    record = OfficialRecord(dataset.stored[0].arrays())
    source, driver = record.frame(0), record.frame(3)
    pipeline = OfficialPipeline.load(model, precision="float32", threads=1)
    offsets = dataset.tables.offsets(source.hair)
    avatar = replace(made_official.avatar(), offsets=offsets, fingerprint=pipeline.fingerprint)
    posed = replace(driver.coefficients, shape=source.coefficients.shape)
    expected = pipeline.pose(avatar, posed, driver.camera, driver.square)
    assert np.allclose(dataset.points(source, driver), expected, atol=1e-5)
    assert np.abs(dataset.points(source, source) - expected).max() > 1e-2
    assert np.abs(dataset.points(driver, driver) - expected).max() > 1e-3  # shape and hair


def test_samples_are_the_papers(data: Path, model: Path) -> None:
    dataset = samples(data, model, 64)
    first, again, other = dataset[1], dataset[1], dataset[2]
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["background"], other["background"])
    assert first["source"].shape == (4, CROP_PIXELS, CROP_PIXELS)
    assert first["driven"].shape == (VIEWS, VERTICES, 3)
    assert first["image"].shape == (VIEWS, 3, 64, 64)
    # The encoder sees the picture over its own background.
    outside = first["source"][:3, first["source"][3] == 0]
    assert outside.numel() == 0 or outside.std() > 0
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
    assert after.sources[-1].used_for == (retrained.RETRAINED,)
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
    with pytest.raises(InputError, match="made for the open preset"):
        official_records(tmp_path)
    with pytest.raises(InputError, match="made for the preset official"):
        training_parts(TrainConfig(data=data / "train", steps=1))
    with pytest.raises(InputError, match="is not exported by this"):
        averaged_model(read(run))
    with pytest.raises(InputError, match="model is for the preset official"):
        configured(data, model, vgg, tmp_path, preset="paper")
    command = ["data", "prepare", str(data), str(tmp_path / "out"), "--model", str(model)]
    assert main(command) == 2
    assert "--model goes with --preset official" in capsys.readouterr().err


def test_the_ablation_becomes_a_model_too(
    data: Path,
    model: Path,
    vgg: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    changes = {"features": "pixel-aligned", "deformation": False}
    checkpoint = train(configured(data, model, vgg, tmp_path / "run", **changes))
    command = [str(checkpoint), str(tmp_path / "model"), "--model", str(model)]
    retrained.main([*command, "--precision", "float32"])
    assert capsys.readouterr().out.strip() == str(tmp_path / "model")
    with pytest.raises(InputError, match="already there"):
        retrained.main(command)
    pipeline = OfficialPipeline.load(tmp_path / "model", threads=1)
    avatar = pipeline.encode(read_image(PORTRAIT), deform=False)
    assert pipeline.render(avatar).rgb.std() > 0
