"""The served networks against the torch model they were made from."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch

from cvthead import Avatar, Pipeline
from cvthead.errors import AssetError
from cvthead.model import splat as torch_splat
from cvthead.model.fill import fill as torch_fill
from cvthead.model.light_unet import even as torch_even
from cvthead.runtime.fill import FILL_LEVELS, ZERO, fill
from cvthead.runtime.mix import evened
from cvthead.runtime.model_folder import (
    DESCRIBE,
    PAINT,
    RECORD,
    ModelFolder,
    packaged,
    write_record,
)
from cvthead.runtime.networks import Networks
from cvthead.runtime.splat import EMPTY_DEPTH, splat
from cvthead.runtime.subpixels import shuffled, unshuffled
from cvthead.source import Source
from cvthead.training.static_int8 import psnr
from tools import engine_page
from tools.engine_page import FloatNetwork

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
MIN_PSNR = 40.0


@pytest.fixture(scope="module")
def exact(pipeline: Pipeline) -> FloatNetwork:
    return FloatNetwork.load(pipeline)


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
    filled = fill(np.where(known[..., None], codes, np.uint8(0)), known)
    # Two roundings to codes.
    assert (
        np.abs(filled.values.astype(np.float32) - ZERO - expected[0].permute(1, 2, 0).numpy()).max()
        <= 1.05
    )
    for level, share in enumerate(shares):
        assert np.abs(filled.coverage[..., level] / 255 - share[0, 0].numpy()).max() < 0.005


def test_the_rest_of_a_filled_value_is_grey() -> None:
    known = np.zeros((128, 128), np.bool_)
    known[:40] = np.random.default_rng(1).random((40, 128)) > 0.7
    codes = np.where(known, np.uint8(228), np.uint8(0))[..., None]
    filled = fill(codes, known)
    assert (filled.part[known] == 1).all()
    assert (filled.part[80:] == 0).all()
    assert ((filled.part > 0.1) & (filled.part < 0.9)).any()
    expected = ZERO + 100 * filled.part
    assert np.abs(filled.values[..., 0] - expected).max() <= 1.05


def test_painted_pixels_are_evened_as_the_network_was_trained() -> None:
    codes = np.random.default_rng(3).integers(60, 200, (32, 32, 4)).astype(np.uint8)
    image = torch.from_numpy(codes).permute(2, 0, 1)[None].float()
    expected = torch_even(image)[0].permute(1, 2, 0).numpy()
    assert np.abs(evened(codes).astype(np.float32) - expected.clip(0, 255)).max() <= 0.51


def test_evening_passes_no_single_pixels_and_leaves_what_is_coarse() -> None:
    row, column = np.indices((32, 32))
    for finest in (row % 2, column % 2, (row + column) % 2):
        assert np.ptp(evened((100 + 80 * finest).astype(np.uint8))[2:-2, 2:-2]) == 0
    assert (evened(np.full((32, 32), 77, np.uint8)) == 77).all()
    wave = 128 + 80 * np.sin(2 * np.pi * row / 8)
    left = np.ptp(evened(wave.astype(np.uint8))[4:-4]) / np.ptp(wave)
    assert left > 0.95  # a filter of 1/4, 1/2, 1/4 leaves .85


def test_subpixels_are_put_back() -> None:
    image = np.random.default_rng(0).integers(0, 256, (16, 16, 4), dtype=np.uint8)
    blocks = unshuffled(image)
    assert np.array_equal(blocks[3, 5], image[6:8, 10:12].reshape(16))
    assert np.array_equal(shuffled(blocks.view(np.uint32)).view(np.uint8).reshape(16, 16, 4), image)


def test_frame_is_the_one_of_the_float_network(
    pipeline: Pipeline, avatar: Avatar, exact: FloatNetwork, source: Source
) -> None:
    descriptors = exact.describe(source)
    for turn in (0.0, 0.4):
        posed = avatar.coefficients.with_joints({"global": (0.1, turn, 0), "jaw": (0.2, 0, 0)})
        points = pipeline.pose(avatar, posed, avatar.camera)
        served = pipeline.paint(avatar, points)
        expected = exact.paint(avatar, source, descriptors, points)
        assert psnr(served.rgba(), expected.rgba()) > MIN_PSNR
        off = cv2.absdiff(served.alpha, expected.alpha)
        assert off.mean() < 255 * 0.01


def test_the_page_of_both_engines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    engine_page.main([str(tmp_path), str(PORTRAIT)])
    assert "| astronaut |" in capsys.readouterr().out
    page = (tmp_path / "index.html").read_text()
    assert page.count("<img") == 3 * len(engine_page.POSES)


def test_descriptors_are_the_ones_of_the_float_network(
    avatar: Avatar, exact: FloatNetwork, source: Source
) -> None:
    expected = exact.describe(source)[0, : len(avatar.descriptors)].numpy()
    steps = avatar.descriptors.astype(np.float32) - ZERO
    # Codes are a multiple of the descriptors, channel by channel.
    largest = (steps * expected).sum(0) / (steps * steps).sum(0)
    inside = (avatar.descriptors > 1) & (avatar.descriptors < 255)
    off = np.abs(steps * largest - expected) / largest
    assert np.quantile(off[inside], 0.999) < 1.0


def test_a_provider_that_is_not_installed_is_refused() -> None:
    with pytest.raises(AssetError, match="no NoSuchExecutionProvider") as caught:
        Pipeline.load(providers=("NoSuchExecutionProvider", "CPUExecutionProvider"))
    assert "CPUExecutionProvider" in str(caught.value.hint)


def test_networks_of_another_version_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    shutil.copytree(packaged("open"), folder)
    network = onnx.load(str(folder / DESCRIBE))
    for given in network.graph.input:
        if given.name == "hidden":
            given.name = "unknown"
    for node in network.graph.node:
        node.input[:] = ["unknown" if name == "hidden" else name for name in node.input]
    onnx.save(network, str(folder / DESCRIBE))
    before = ModelFolder.load(folder)
    write_record(folder, before.preset, before.fingerprint, before.training)
    with pytest.raises(AssetError, match="another version") as caught:
        Networks.load(folder)
    assert "export" in str(caught.value.hint)


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


def test_the_service_and_rendering_need_no_torch() -> None:
    code = """
import sys
import cvthead.cli.main, service.app
from cvthead.pipeline import Pipeline
from service.warmup import warm_up
warm_up(Pipeline.load(threads=1))
sys.exit("torch" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
