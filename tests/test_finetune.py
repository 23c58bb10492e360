"""``cvthead finetune`` from a picture to a model that the other commands take; ablations."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")

import torch

from cvthead.cli.main import main
from cvthead.errors import AssetError, InputError
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel
from cvthead.images import read_image
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.model.splat import splat
from cvthead.points import PointLayout
from cvthead.runtime.model_folder import packaged
from cvthead.training.export import averaged_model, forget_portrait
from cvthead.training.perceptual import perceptual_weights

pytestmark = pytest.mark.usefixtures("one_thread")

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
SMALL = [
    word
    for setting in ("size=32", "steps=1", "batch=1", "workers=0", "features=pixel-aligned")
    for word in ("--set", setting)
]


def test_one_command_makes_a_model_of_videos(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A single step of an ablation, so that its export is seen to work too."""
    try:
        perceptual_weights("alex")
    except AssetError as error:
        pytest.skip(f"no perceptual weights: {error}")
    (tmp_path / "videos" / "me").mkdir(parents=True)
    shutil.copy(PORTRAIT, tmp_path / "videos" / "me")
    command = ["finetune", str(tmp_path / "videos"), str(tmp_path / "out"), "--processes", "1"]
    assert main([*command, *SMALL]) == 0
    model = tmp_path / "out" / "model"
    assert capsys.readouterr().out.splitlines()[-1] == str(model)
    training = json.loads((model / "model.json").read_text())["training"]
    assert training["features"] == "pixel-aligned"
    assert training["step"] == "1"
    shipped = json.loads((packaged("open") / "model.json").read_text())
    assert training["began_with"] == shipped["fingerprint"]
    assert json.loads(training["settings"])["optimiser"]["learning_rate"] == 1e-4
    assert "licence" not in training  # who fine-tunes knows what the videos allow

    avatar, picture = str(tmp_path / "me.avatar"), tmp_path / "me.png"
    assert main(["encode", str(PORTRAIT), "--model", str(model), "-o", avatar]) == 0
    assert main(["render", avatar, "-o", str(picture)]) == 2
    assert "made with weights" in capsys.readouterr().err
    assert main(["render", avatar, "--model", str(model), "-o", str(picture)]) == 0
    assert read_image(picture).std() > 10


def test_nothing_usable_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.png").write_bytes(b"no picture")
    command = ["finetune", str(tmp_path), str(tmp_path / "out"), "--processes", "1"]
    assert main(command) == 2
    assert "none of the files" in capsys.readouterr().err
    assert main([*command, "--set", "preset=paper"]) == 2
    assert "does not know the preset paper" in capsys.readouterr().err


def test_without_the_portrait_the_runtime_paints_what_training_did() -> None:
    """The exported network gets portrait and visibility, and must ignore both."""
    torch.manual_seed(0)
    layout = PointLayout.of(HeadModel.load())
    model = CVTHead(replace(OPEN, features="transformer"), MeshHierarchy.load(), layout).eval()
    points = torch.rand(1, 900, 3) * 2 - 1
    descriptors = torch.randn(1, 900, OPEN.descriptor_size)
    seen, warped = torch.rand(1, 900), torch.rand(1, 4, 64, 64) * 2 - 1
    with torch.inference_mode():
        trained = model.paint(points, descriptors, seen, warped)
    forget_portrait(model)
    image = splat(points, torch.cat([descriptors, seen[..., None]], dim=-1), 32)
    with torch.inference_mode():
        for portrait in (warped, -warped):
            # As the runtime runs every network.
            served = model.unet(model.filled(image), portrait)
            torch.testing.assert_close(served, trained, atol=2e-3, rtol=0)


def test_a_run_of_the_papers_network_is_not_exported() -> None:
    with pytest.raises(InputError, match="preset paper"):
        averaged_model({"config": {"preset": "paper"}})
