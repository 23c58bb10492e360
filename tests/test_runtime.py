"""The served networks against the torch model they were made from."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from cvthead import Avatar, Pipeline
from cvthead.deformation import MAX_SHELL_POINTS
from cvthead.errors import AssetError
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.images import read_image
from cvthead.model import splat as torch_splat
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.model.fill import fill as torch_fill
from cvthead.points import FAR_AWAY
from cvthead.runtime.fill import FILL_LEVELS, ZERO, fill
from cvthead.runtime.model_folder import PAINT, RECORD, WEIGHTS, ModelFolder, packaged
from cvthead.runtime.networks import Networks
from cvthead.runtime.splat import EMPTY_DEPTH, splat
from cvthead.runtime.subpixels import shuffled, unshuffled
from cvthead.source import Source, as_network_input, cut_head, read_source
from cvthead.weights import load_into

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
MIN_PSNR = 40.0


@pytest.fixture(scope="module")
def source(pipeline: Pipeline) -> Source:
    image = read_image(PORTRAIT)
    crop = cut_head(pipeline.tracker, image, pipeline.tracker.track(image))
    return read_source(pipeline.deformer, pipeline.layout, crop)


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
    rows = np.arange(3000, dtype=np.float32)[:, None]
    expected = torch_splat.splat(torch.from_numpy(points)[None], torch.from_numpy(rows)[None], 64)
    depth, number = expected[0].numpy()
    owner = splat(points, 64)
    assert np.array_equal(owner >= 0, depth > EMPTY_DEPTH)
    assert np.array_equal(owner[owner >= 0], number[owner >= 0])


def test_fill_is_the_one_the_network_was_trained_with() -> None:
    rng = np.random.default_rng(0)
    codes = cv2.GaussianBlur(rng.integers(0, 256, (128, 128, 4)).astype(np.float32), (0, 0), 3)
    codes = codes.round().astype(np.uint8)
    known = rng.random((128, 128)) > 0.8
    known[:50, :60] = False
    values = torch.from_numpy(codes.astype(np.float32) - ZERO).permute(2, 0, 1)[None]
    weight = torch.from_numpy(known.astype(np.float32))[None, None]
    expected, shares = torch_fill(values, weight, FILL_LEVELS)
    filled, coverage = fill(np.where(known[..., None], codes, np.uint8(0)), known)
    # Two roundings to codes.
    assert (
        np.abs(filled.astype(np.float32) - ZERO - expected[0].permute(1, 2, 0).numpy()).max()
        <= 1.05
    )
    for level, share in enumerate(shares):
        assert np.abs(coverage[..., level] / 255 - share[0, 0].numpy()).max() < 0.005


def test_subpixels_are_put_back() -> None:
    image = np.random.default_rng(0).integers(0, 256, (16, 16, 4), dtype=np.uint8)
    blocks = unshuffled(image)
    assert np.array_equal(blocks[3, 5], image[6:8, 10:12].reshape(16))
    assert np.array_equal(shuffled(blocks.view(np.uint32)).view(np.uint8).reshape(16, 16, 4), image)


def test_frame_is_the_one_of_the_float_network(
    pipeline: Pipeline, avatar: Avatar, model: CVTHead, source: Source
) -> None:
    for turn in (0.0, 0.4):
        posed = avatar.coefficients.with_joints({"global": (0.1, turn, 0), "jaw": (0.2, 0, 0)})
        points = pipeline.pose(avatar, posed, avatar.camera)
        every = np.tile(FAR_AWAY, (pipeline.layout.total, 1))
        every[: len(points)] = points
        frame = pipeline.paint(avatar, points)
        warped = as_network_input(pipeline.place(avatar, points).warped)
        rgb, logits = model.paint(
            torch.from_numpy(every)[None],
            model.describe(*inputs(source)),
            torch.from_numpy(source.places(pipeline.layout)[None, :, 2]),
            torch.from_numpy(warped)[None],
        )
        alpha = logits[0, 0].sigmoid().numpy()
        expected = (rgb[0].permute(1, 2, 0).numpy() + 1) * 127.5 * alpha[..., None]
        shown = frame.rgb * (frame.alpha[..., None] / 255.0)
        assert 10 * np.log10(255**2 / np.mean((shown - expected) ** 2)) > MIN_PSNR
        assert np.abs(frame.alpha / 255.0 - alpha).mean() < 0.01


def inputs(source: Source) -> list[torch.Tensor]:
    anchor = np.zeros((1, MAX_SHELL_POINTS), np.int64)
    anchor[0, : len(source.deformation.shell_anchor)] = source.deformation.shell_anchor
    each = source.network_input, source.points, source.visible.astype(np.float32)
    return [*(torch.from_numpy(x)[None] for x in each), torch.from_numpy(anchor)]


def test_descriptors_are_the_ones_of_the_float_network(
    pipeline: Pipeline, avatar: Avatar, model: CVTHead, source: Source
) -> None:
    expected = model.describe(*inputs(source))[0, : len(avatar.descriptors)].numpy()
    steps = avatar.descriptors.astype(np.float32) - ZERO
    # Codes are a multiple of the descriptors, channel by channel.
    largest = (steps * expected).sum(0) / (steps * steps).sum(0)
    inside = (avatar.descriptors > 1) & (avatar.descriptors < 255)
    off = np.abs(steps * largest - expected) / largest
    assert np.quantile(off[inside], 0.999) < 1.0


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
