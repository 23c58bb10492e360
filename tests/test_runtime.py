"""The served networks against the torch model they were made from."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from cvthead import Avatar, Pipeline
from cvthead.errors import AssetError
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.images import read_image
from cvthead.model import splat as torch_splat
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.runtime.model_folder import PAINT, RECORD, WEIGHTS, ModelFolder, packaged
from cvthead.runtime.networks import Networks
from cvthead.runtime.splat import splat
from cvthead.source import as_network_input
from cvthead.weights import load_into

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
MIN_PSNR = 40.0


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    return Pipeline.load()


@pytest.fixture(scope="module")
def avatar(pipeline: Pipeline) -> Avatar:
    return pipeline.encode(read_image(PORTRAIT))


@pytest.fixture(scope="module")
def model(pipeline: Pipeline) -> CVTHead:
    model = CVTHead(OPEN, MeshHierarchy.load(), pipeline.layout)
    assert load_into(model, packaged("open") / WEIGHTS) == pipeline.fingerprint
    return model.eval().requires_grad_(False)


@pytest.mark.parametrize("seed", range(5))
def test_splat_is_the_one_the_network_was_trained_with(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.2, 1.2, (3000, 3)).astype(np.float32)
    points[:500, 2] = points[500:1000, 2]  # equal depths
    points[:200, :2] = points[500:700, :2]
    rows = rng.normal(size=(3000, 5)).astype(np.float32)
    expected = torch_splat.splat(torch.from_numpy(points)[None], torch.from_numpy(rows)[None], 64)
    assert np.array_equal(splat(points, rows, 64), expected[0].permute(1, 2, 0).numpy())


def test_frame_is_the_one_of_the_float_network(
    pipeline: Pipeline, avatar: Avatar, model: CVTHead
) -> None:
    for turn in (0.0, 0.4):
        posed = avatar.coefficients.with_joints({"global": (0.1, turn, 0), "jaw": (0.2, 0, 0)})
        points = pipeline.pose(avatar, posed, avatar.camera)
        frame = pipeline.paint(avatar, points)
        warped = as_network_input(pipeline.place(avatar, points).warped)
        rgb, logits = model.paint(
            torch.from_numpy(points)[None],
            torch.from_numpy(avatar.rows)[None],
            torch.from_numpy(warped)[None],
        )
        alpha = logits[0, 0].sigmoid().numpy()
        expected = (rgb[0].permute(1, 2, 0).numpy() + 1) * 127.5 * alpha[..., None]
        shown = frame.rgb * (frame.alpha[..., None] / 255.0)
        assert 10 * np.log10(255**2 / np.mean((shown - expected) ** 2)) > MIN_PSNR
        assert np.abs(frame.alpha / 255.0 - alpha).mean() < 0.01


def test_descriptors_are_the_ones_of_the_float_network(
    pipeline: Pipeline, avatar: Avatar, model: CVTHead
) -> None:
    from cvthead.source import cut_head, read_source

    image = read_image(PORTRAIT)
    crop = cut_head(pipeline.tracker, image, pipeline.tracker.track(image))
    source = read_source(pipeline.deformer, pipeline.layout, crop)
    anchor = np.zeros((1, 512), np.int64)
    anchor[0, : len(source.deformation.shell_anchor)] = source.deformation.shell_anchor
    expected = model.describe(
        torch.from_numpy(source.network_input)[None],
        torch.from_numpy(source.points)[None],
        torch.from_numpy(source.visible.astype(np.float32))[None],
        torch.from_numpy(anchor),
    )[0].numpy()
    found = pipeline.networks.describe(source)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() < 0.01 * expected.std()


def test_altered_or_missing_files_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    shutil.copytree(packaged("open"), folder)
    assert ModelFolder.load(folder).fingerprint == Networks.load(folder).fingerprint
    data = bytearray((folder / PAINT).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / PAINT).write_bytes(data)
    with pytest.raises(AssetError, match="not the recorded file"):
        Networks.load(folder)
    (folder / PAINT).unlink()
    with pytest.raises(AssetError, match="is missing"):
        Networks.load(folder)
    for broken in ("{", "[]", json.dumps({"preset": "open"})):
        (folder / RECORD).write_text(broken)
        with pytest.raises(AssetError, match="not a model folder"):
            Networks.load(folder)


def test_rendering_needs_no_torch() -> None:
    code = "import sys, cvthead.cli.main, cvthead.pipeline; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
