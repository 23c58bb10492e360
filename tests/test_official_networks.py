"""The imported networks on onnxruntime: against PyTorch, in 8 bits, and without PyTorch."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from cvthead.cli.import_official import precisions
from cvthead.cli.main import main
from cvthead.controls import Controls
from cvthead.frame import Frame
from cvthead.images import read_image
from cvthead.model.bisenet import foreground as torch_foreground
from cvthead.model.splat import splat_clamped
from cvthead.official.avatar import OfficialAvatar
from cvthead.official.manifest import (
    DESCRIBE_INT8_ONNX,
    DESCRIBE_ONNX,
    EIGHT_BIT,
    FILES,
    MIN_PSNR,
    UNET_INT8_ONNX,
    UNET_ONNX,
    Manifest,
    write_manifest,
)
from cvthead.official.networks import Network, foreground
from cvthead.official.painted import Painted
from cvthead.official.pipeline import OfficialPipeline
from cvthead.official.quantise import (
    keep_if_close,
    quantised_encoder,
    quantised_unet,
    sample_views,
    source_of,
)
from cvthead.official.splat import splat
from cvthead.runtime.sessions import open_session
from cvthead.training.static_int8 import psnr

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
SIZE = 256
DWARFING = 300.0


@pytest.fixture(scope="module")
def model(official_folder: Path) -> Path:
    return official_folder / "model"


@pytest.fixture(scope="module")
def pipeline(model: Path) -> OfficialPipeline:
    return OfficialPipeline.load(model, precision="float32")


@pytest.fixture(scope="module")
def avatar(pipeline: OfficialPipeline) -> OfficialAvatar:
    return pipeline.encode(read_image(PORTRAIT))


def test_splat_is_that_of_pytorch() -> None:
    """Bit for bit, with crowded pixels, equal depths, points outside and halves of a pixel."""
    random = np.random.default_rng(0)
    points = random.uniform(-1.3, 1.3, (5023, 3)).astype(np.float32)
    points[:2000, :2] = np.round(points[:2000, :2] * SIZE) / SIZE
    points[::3, 2] = np.round(points[::3, 2])
    descriptors = random.normal(size=(5023, 32)).astype(np.float32)
    projected, rows = (torch.from_numpy(each)[None] for each in (points, descriptors))
    expected = splat_clamped(projected, rows, SIZE)
    found = splat(points, descriptors, SIZE, 36)
    assert np.array_equal(found[..., :33], expected[0].permute(1, 2, 0).numpy())
    assert not found[..., 33:].any()


def test_foreground_is_that_of_pytorch() -> None:
    logits = np.random.default_rng(0).integers(0, 4, (1, 19, 32, 32)).astype(np.float32)
    logits[:, 0] += 2
    expected = torch_foreground(torch.from_numpy(logits)).numpy()
    assert 0 < expected.mean() < 1
    assert np.array_equal(foreground(logits), expected)


def test_frame_rounds_and_over_white_truncates() -> None:
    raw = np.random.default_rng(0).normal(0, 3, (SIZE, SIZE, 4)).astype(np.float32)
    rgb, mask = 0.5 * (torch.tanh(torch.tensor(raw[..., :3])) + 1), torch.tensor(raw[..., 3:])
    painted = torch.cat([rgb, torch.sigmoid(mask)], dim=-1) * 255
    difference = Painted(raw).frame().rgba() - painted.numpy()
    assert np.abs(difference).max() < 0.501
    white = (rgb * torch.sigmoid(mask) + 1 - torch.sigmoid(mask)) * 255
    difference = white.numpy() - Painted(raw).over_white()
    assert difference.min() > -0.001
    assert difference.max() < 1.001


def test_the_eight_bit_networks_paint_what_the_float_ones_do(
    model: Path, pipeline: OfficialPipeline
) -> None:
    """And are served, with the made-up weights, unless they are not close enough."""
    served = OfficialPipeline.load(model)
    close = {
        name: served.networks.manifest.psnr[small] >= MIN_PSNR for name, small in EIGHT_BIT.items()
    }
    assert any(close.values())
    assert served.networks.precision == {
        name: "int8" if good else "float32" for name, good in close.items()
    }
    assert set(pipeline.networks.precision.values()) == {"float32"}
    controls = Controls(global_rotation=(0, 0.2, 0), mode="relative")
    frames = [
        each.render(each.encode(read_image(PORTRAIT)), controls).rgba()
        for each in (served, pipeline)
    ]
    assert psnr(*frames) > MIN_PSNR - 3
    assert not np.array_equal(frames[0], frames[1])


@pytest.fixture(scope="module")
def uneven(model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same import, but one channel inside its U-Net dwarfs the others, which 8 bits with one
    range for all cannot show; the next layer takes the factor back."""
    folder = tmp_path_factory.mktemp("uneven")
    for name in FILES:
        (folder / name).symlink_to(model / name)
    network = onnx.load(str(model / UNET_ONNX))
    first, second = [node for node in network.graph.node if node.op_type == "Conv"][:2]
    tables = {table.name: table for table in network.graph.initializer}

    def scaled(name: str, where: tuple[slice | int, ...], factor: float) -> None:
        values = onnx.numpy_helper.to_array(tables[name]).copy()
        values[where] *= factor
        tables[name].CopyFrom(onnx.numpy_helper.from_array(values, name))

    for name in first.input[1:]:  # without its bias where that is 0
        scaled(name, (0,), DWARFING)
    scaled(second.input[1], (slice(None), 0), 1 / DWARFING)
    (folder / UNET_ONNX).unlink()
    onnx.save(network, str(folder / UNET_ONNX))
    write_manifest(folder, ())
    return folder


def test_a_poor_eight_bit_unet_is_not_served(
    uneven: Path, pipeline: OfficialPipeline, avatar: OfficialAvatar
) -> None:
    portrait = read_image(PORTRAIT)
    network = quantised_unet(uneven / UNET_ONNX, sample_views(pipeline, [portrait], 2))
    exact = OfficialPipeline.load(uneven, precision="float32")
    lowest, kept = keep_if_close(exact, exact, UNET_ONNX, network, [portrait])
    assert lowest < MIN_PSNR
    assert kept is exact
    write_manifest(uneven, (), {UNET_INT8_ONNX: lowest, DESCRIBE_INT8_ONNX: 0})
    record = Manifest.load(uneven)
    assert UNET_INT8_ONNX not in record.sha256
    assert f"{UNET_ONNX} is served" in precisions(record)
    served = OfficialPipeline.load(uneven)
    assert served.networks.precision[UNET_ONNX] == "float32"
    frames: list[Frame] = [each.render(avatar) for each in (served, pipeline)]
    assert psnr(*(frame.rgba() for frame in frames)) > 60


def test_a_poor_eight_bit_encoder_is_not_served(
    model: Path, pipeline: OfficialPipeline, avatar: OfficialAvatar
) -> None:
    """One that was calibrated on a black picture has no range for a portrait."""
    portrait = read_image(PORTRAIT)
    source = source_of(pipeline, portrait, avatar)
    black = {name: np.zeros_like(value) for name, value in source.items()}
    network = quantised_encoder(model / DESCRIBE_ONNX, [black])
    lowest, kept = keep_if_close(pipeline, pipeline, DESCRIBE_ONNX, network, [portrait])
    assert lowest < MIN_PSNR
    assert kept is pipeline


def test_the_last_layer_stays_in_float(pipeline: OfficialPipeline, model: Path) -> None:
    """Colours before tanh have no range that fits 256 steps."""
    views = sample_views(pipeline, [read_image(PORTRAIT)], 1)
    network = quantised_unet(model / UNET_ONNX, views)
    small = Network(open_session(network.SerializeToString(), 1), keeps_memory=True)
    (raw,) = small(views[0])
    assert len(np.unique(raw[..., 0])) > 256


def test_serving_needs_no_pytorch(model: Path, avatar: OfficialAvatar, tmp_path: Path) -> None:
    avatar.save(tmp_path / "me.avatar")
    script = """
import sys
from pathlib import Path
from cvthead.images import read_image
from cvthead.preset import load_avatar, load_preset
preset = load_preset("official", model=Path(sys.argv[1]))
face = preset.tracker.track(read_image(sys.argv[2]))
frame = preset.render_coefficients(load_avatar(Path("me.avatar")), face.coefficients, face.camera)
assert frame.rgb.shape == (256, 256, 3)
absent = {"torch", "onnx", "einops"} & set(sys.modules)
assert not absent, absent
"""
    command = [sys.executable, "-c", script, str(model), str(PORTRAIT)]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_bench_names_every_stage(
    model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CVTHEAD_OFFICIAL", str(model))
    command = ["bench", str(PORTRAIT), "--preset", "official", "--renders", "2", "--json"]
    assert main(command) == 0
    report = json.loads(capsys.readouterr().out)
    encode = {"track", "parsing", "hair", "DECA", "describe", "background", "all of encode"}
    assert set(report["encode"]) == encode
    pictures = {"composite on colour", "to png", "to jpeg", "to webp"}
    frame = {"pose", "splat", "U-Net", "to frame", "all of render"}
    assert set(report["render"]) == frame | pictures
    assert set(report["drive"]) == {"decode JPEG", "track", "render", "to JPEG", "JPEG to JPEG"}
    assert set(report["torch"]) == set(report["ratios"]) == {"official preset"}
    assert set(report["precision"]) == set(EIGHT_BIT)
    assert report["preset"] == "official"
