"""Training on records of the sample portrait: samples, resuming, configurations."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning_fabric import Fabric
from made_records import make_records, portrait_crop

from cvthead.cli.main import main
from cvthead.deformation import DeformationModel
from cvthead.errors import AssetError, InputError
from cvthead.head.model import HeadModel
from cvthead.points import FAR_AWAY, PointLayout
from cvthead.source import read_source
from cvthead.tracking.tracker import Tracker
from cvthead.training import records
from cvthead.training.config import TrainConfig, load_config, merged, setting
from cvthead.training.dataset import PairDataset, flip_order, flip_points
from cvthead.training.perceptual import perceptual_weights
from cvthead.training.renderers import OpenRenderer
from cvthead.training.train import autocast, train

pytestmark = pytest.mark.usefixtures("one_thread")

# Of a resumed run's losses; the sums' order in a thread pool is all that may differ.
TOLERANCE = 1e-4

LEARNT = 0.9  # of the first step's losses, after 40


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.load()


@pytest.fixture(scope="module")
def layout(head: HeadModel) -> PointLayout:
    return PointLayout.of(head)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("records")
    make_records(path)
    return path


@pytest.fixture(scope="module")
def _perceptual() -> None:
    try:
        perceptual_weights("alex")
    except AssetError as error:
        pytest.skip(f"no perceptual weights: {error}")


def small(folder: Path, run: Path, **changes: Any) -> dict[str, Any]:
    """A configuration that runs in seconds."""
    values = {
        "data": str(folder),
        "run": str(run),
        "size": 64,
        "steps": 4,
        "batch": 1,
        "workers": 0,
        "log_every": 1,
        "save_every": 2,
        "average": 0.9,
    }
    return values | changes


def log_of(run: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


def assert_same_curve(one: Path, other: Path) -> None:
    """The losses of two runs agree step by step within TOLERANCE."""
    first, second = log_of(one), log_of(other)
    assert [line["step"] for line in first] == [line["step"] for line in second]
    for a, b in zip(first, second, strict=True):
        assert a.keys() == b.keys()
        for name in a.keys() - {"seconds_per_step"}:
            assert a[name] == pytest.approx(b[name], rel=TOLERANCE), (name, a["step"])


def test_a_record_keeps_what_was_tracked(
    head: HeadModel, layout: PointLayout, tmp_path: Path
) -> None:
    crop = portrait_crop(Tracker.load(head))
    source = read_source(DeformationModel.from_head(head), layout, crop)
    records.write(tmp_path / "portrait.npz", [crop], {0: source})
    (where,) = records.stored_records(tmp_path)
    stored = where.open()
    assert np.array_equal(stored.visible(0, layout.total), source.visible)
    assert np.allclose(stored.deformation(0).offsets, source.deformation.offsets, atol=1e-4)
    assert np.abs(stored.frame(0).image.astype(int) - crop.image).mean() < 3


def test_a_sample_depends_on_seed_and_number_alone(
    folder: Path, head: HeadModel, layout: PointLayout
) -> None:
    def dataset(seed: int) -> PairDataset:
        return PairDataset(folder, head, layout, size=64, seed=seed, samples=8)

    first, again, other = dataset(1)[3], dataset(1)[3], dataset(2)[3]
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["source"], other["source"])


@pytest.mark.usefixtures("_perceptual")
def test_half_precision_leaves_the_points_where_they_are(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = []

    def forward(self: OpenRenderer, batch: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        kinds.append({batch[name].dtype for name in ("points", "driven", "warped")})
        return original(self, batch)

    original = OpenRenderer.forward
    monkeypatch.setattr(OpenRenderer, "forward", forward)
    values = small(folder, tmp_path / "run", steps=1, precision="bf16-mixed")
    train(TrainConfig.model_validate(values))
    assert kinds == [{torch.float32}]


@pytest.mark.parametrize(
    ("precision", "capable", "half"),
    [("auto", True, True), ("auto", False, False), ("32-true", True, False)],
)
def test_half_precision_is_for_processors_that_compute_in_it(
    precision: str, capable: bool, half: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": capable})
    config = TrainConfig.model_validate({"steps": 1, "precision": precision})
    with autocast(Fabric(accelerator="cpu"), config):
        product = torch.ones(2, 2) @ torch.ones(2, 2)
    assert product.dtype == (torch.bfloat16 if half else torch.float32)


def test_without_deformation_no_shell_is_drawn(
    folder: Path, head: HeadModel, layout: PointLayout
) -> None:
    haired, bald = (
        PairDataset(folder, head, layout, size=64, seed=1, samples=8, deform=deform)
        for deform in (True, False)
    )
    shell = slice(layout.surface, None)
    for number in range(8):  # imagined views among them
        with_hair, without = haired[number], bald[number]
        assert (with_hair["driven"][:, shell, 0] > -2).any()
        assert not (without["driven"][:, shell, 0] > -2).any()
        assert torch.equal(with_hair["image"], without["image"])
        assert torch.equal(with_hair["mask"], without["mask"])


def test_a_still_often_shows_what_its_points_imagine(
    folder: Path, head: HeadModel, layout: PointLayout
) -> None:
    """Views turned far whose picture lies where their points do; none without augmentation."""

    def turned(**choice: Any) -> list[dict[str, torch.Tensor]]:
        data = PairDataset(folder, head, layout, size=64, seed=2, samples=24, **choice)
        samples = [data[number] for number in range(24)]
        # The second view is always the still's mirror image; the first one then is not its own.
        return [s for s in samples if not torch.allclose(s["mask"][0], s["mask"][1].flip(-1))]

    assert not turned(augment=False)
    assert not turned(whole=True)
    found = turned()
    assert 24 * 0.35 < len(found) < 24 * 0.85
    for sample in found:
        points, mask = sample["driven"][0], sample["mask"][0, 0]
        pixel = ((points[:, :2] * 0.5 + 0.5) * 64).long()
        inside = ((pixel >= 0) & (pixel < 64)).all(-1)
        column, row = pixel[inside].T
        assert (mask[row, column] > 0.5).float().mean() > 0.95
        assert sample["valid"][0].min() == 1


def test_the_paper_draws_what_the_portrait_cuts_off(
    folder: Path, head: HeadModel, layout: PointLayout
) -> None:
    cut, whole = (
        PairDataset(folder, head, layout, size=64, seed=1, samples=4, augment=False, whole=whole)[
            0
        ]["driven"][0, : layout.vertices]
        for whole in (False, True)
    )
    away = (cut == torch.from_numpy(FAR_AWAY)).all(dim=1)
    assert away.any()
    assert whole.abs().max() < 3
    assert torch.equal(whole[~away], cut[~away])


def test_pixel_aligned_features_alone_know_of_nothing_hidden(
    folder: Path, head: HeadModel, layout: PointLayout
) -> None:
    fused, alone = (
        PairDataset(folder, head, layout, size=128, seed=1, samples=4, all_seen=all_seen)[0]
        for all_seen in (False, True)
    )
    surface = slice(0, layout.surface)
    assert np.unique(fused["seen"][:, surface]).tolist() == [0, 0.5, 1]
    assert (alone["seen"][:, surface] == 1).all()
    assert not torch.equal(fused["warped"], alone["warped"])
    # What is compared, and how heavily, stays the same.
    assert float(fused["weight"].max()) > 1
    for name in ("source", "image", "mask", "valid", "weight", "driven"):
        assert torch.equal(fused[name], alone[name])


def test_the_mirror_image_of_a_still_carries_no_hair_across_the_face(
    folder: Path, head: HeadModel, layout: PointLayout
) -> None:
    sample = PairDataset(folder, head, layout, size=64, seed=1, samples=4, augment=False)[0]
    own, mirror = sample["seen"][:, layout.surface :]
    assert own.max() == 1
    assert mirror.max() == 0
    assert torch.equal(*sample["seen"][:, : layout.surface])


def test_without_augmentation_the_picture_stays(
    folder: Path, head: HeadModel, layout: PointLayout
) -> None:
    dataset = PairDataset(folder, head, layout, size=256, seed=1, samples=4, augment=False)
    (stored,) = records.stored_records(folder)
    frame = stored.open().frame(0)
    for number in range(4):
        # The second view of a still is its mirror image, augmented or not.
        picture = dataset[number]["image"][0].permute(1, 2, 0).numpy() * 255
        assert np.abs(picture - frame.image).max() < 0.01


def test_flip_is_its_own_inverse(layout: PointLayout) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(layout.total, 3)).astype(np.float32)
    assert np.array_equal(flip_points(flip_points(points, layout), layout), points)
    assert not np.array_equal(flip_order(points, layout), points)


@pytest.mark.usefixtures("_perceptual")
def test_resumed_run_equals_one_without_a_break(folder: Path, tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    changes = {"freeze_norm": 0.5, "precision": "32-true"}
    train(TrainConfig(**small(folder, whole, **changes)))
    config = TrainConfig(**small(folder, parts, **changes))
    train(config, sitting=2)
    assert torch.load(parts / "checkpoint.pt", weights_only=True)["step"] == 2
    train(config)
    states = [torch.load(run / "checkpoint.pt", weights_only=True) for run in (whole, parts)]
    assert states[0]["step"] == states[1]["step"] == 4
    for name, value in states[0]["averaged"].items():
        torch.testing.assert_close(states[1]["averaged"][name], value, rtol=1e-4, atol=1e-5)
    assert_same_curve(whole, parts)
    assert (parts / "samples.png").is_file()
    assert list((parts / "tensorboard").glob("events.*"))
    with pytest.raises(InputError, match="other settings: steps"):
        train(TrainConfig(**small(folder, parts, **changes | {"steps": 9})))


@pytest.mark.usefixtures("_perceptual")
def test_two_processes_resume_after_a_kill(folder: Path, tmp_path: Path) -> None:
    """The same run twice under torchrun: straight, and killed after step 3 of 4, which goes on
    from step 2."""
    changes = {"batch": 2, "steps": 4, "precision": "32-true", "workers": 1}
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    run_two(small(folder, whole, **changes), tmp_path)
    run_two(small(folder, broken, **changes), tmp_path, kill_after=3)
    assert torch.load(broken / "checkpoint.pt", weights_only=True)["step"] == 2
    run_two(small(folder, broken, **changes), tmp_path)
    assert torch.load(broken / "checkpoint.pt", weights_only=True)["step"] == 4
    assert_same_curve(whole, broken)


def run_two(values: dict[str, Any], folder: Path, kill_after: int | None = None) -> None:
    """Two training processes; with ``kill_after``, both are killed once that step is logged."""
    config = folder / "config.toml"
    config.write_text("\n".join(f"{key} = {json.dumps(value)}" for key, value in values.items()))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc-per-node", "2", "-m", "cvthead.cli.main", "train", str(config)]
    log = Path(values["run"]) / "log.jsonl"
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        if kill_after is not None:
            while process.poll() is None and not (
                log.exists() and len(log.read_text().splitlines()) >= kill_after
            ):
                time.sleep(0.02)
            for worker in (
                Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            ):
                os.kill(int(worker), signal.SIGKILL)
        output, _ = process.communicate()
    assert (process.returncode == 0) == (kill_after is None), output


@pytest.mark.usefixtures("_perceptual")
def test_a_portrait_is_learnt(folder: Path, tmp_path: Path) -> None:
    """The short version of tests/nightly/test_overfit.py: the smoothed losses fall
    below LEARNT of their start."""
    optimiser = {"name": "adamw", "learning_rate": 2e-3, "warm_up": 5, "clip_norm": 1.0}
    weights = {"perceptual": 0.5}
    config = small(folder, tmp_path, steps=40, save_every=40, losses=weights, optimiser=optimiser)
    train(TrainConfig(**config, precision="32-true"))
    curve = log_of(tmp_path)
    for name in ("l1", "perceptual", "dice"):
        assert curve[-1][name] < LEARNT * curve[0][name], name


def test_shipped_configurations_are_valid() -> None:
    fine = load_config("finetune", {"data": Path("d")})
    assert fine.init == "shipped"
    assert fine.data == Path("d")
    assert load_config("open.toml", {}).optimiser.betas == (0.9, 0.99)
    parts = [load_config(name, {}) for name in ("open-coarse", "open", "open-fine")]
    assert [(part.size, part.seed) for part in parts] == [(128, 0), (256, 0), (256, 1)]
    for name, stage, adversarial in (("paper", 1, 0), ("paper-stage2", 2, 0.1)):
        paper = load_config(name, {})
        assert (paper.preset, paper.batch, paper.stage) == ("paper", 16, stage)
        assert (paper.optimiser.name, paper.optimiser.learning_rate) == ("adam", 1e-4)
        weights = paper.losses
        assert (weights.l1, weights.perceptual, weights.dice, weights.identity) == (1, 1, 1, 0.1)
        assert weights.adversarial == adversarial


def test_single_keys_are_set_from_the_command_line() -> None:
    given = merged(setting("losses.dice=0.5"), setting("features=pixel-aligned"))
    config = load_config("open", merged(given, setting("losses.l1 = 2")))
    assert config.features == "pixel-aligned"
    kept = load_config("open", {}).losses.perceptual
    assert (config.losses.dice, config.losses.l1, config.losses.perceptual) == (0.5, 2, kept)
    for text in ("steps", "=3", "a b=3"):
        with pytest.raises(InputError, match="sets no key"):
            setting(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps = 'many'", "steps: "),
        ("steps = 3\nspeed = 2", "speed: "),
        ("steps = 3\nsize = 100", "size: "),
        ("steps = 3\nstage = 2", "losses.adversarial"),
        ("steps = 3\npreset = 'paper'\nfeatures = 'transformer'", "remove features"),
        ("steps = 3\n[losses]\nidentity = 0.1", "networks.identity"),
        ("steps = ", "not TOML"),
    ],
)
def test_a_wrong_configuration_costs_one_line(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.toml").write_text(text)
    assert main(["train", str(tmp_path / "c.toml")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_missing_records_and_weights_are_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "open", "--data", str(tmp_path)]) == 2
    assert "no records" in capsys.readouterr().err
    assert main(["train", "paper", "--data", str(folder)]) == 2
    assert "vgg19.pth" in capsys.readouterr().err
