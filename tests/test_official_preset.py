"""The imported preset from a portrait to frames, in the library and on the command line."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from cvthead.cli.main import main
from cvthead.controls import Controls
from cvthead.driving import drive
from cvthead.errors import AssetError, AvatarFileError, CoefficientsError, ModelChangedError
from cvthead.head.arkit import ARKIT_NAMES
from cvthead.images import read_image
from cvthead.official.avatar import OfficialAvatar
from cvthead.official.networks import Network
from cvthead.official.pipeline import OfficialPipeline
from cvthead.preset import Preset, load_preset
from cvthead.video_writer import video_writer

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"


@pytest.fixture
def folder(official_folder: Path) -> Path:
    return official_folder


@pytest.fixture(scope="module")
def pipeline(official_folder: Path) -> OfficialPipeline:
    return OfficialPipeline.load(official_folder / "model")


@pytest.fixture(scope="module")
def avatar(pipeline: OfficialPipeline) -> OfficialAvatar:
    return pipeline.encode(read_image(PORTRAIT))


ONCE_PER_SOURCE = ("parsing", "hair", "deca", "describe")


class Counted:
    """A network that counts its passes."""

    def __init__(self, name: str, network: Network, passes: Counter[str]) -> None:
        self.name, self.network, self.passes = name, network, passes

    def __call__(self, *inputs: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        self.passes[self.name] += 1
        return self.network(*inputs)

    @property
    def channels(self) -> int:
        return self.network.channels


def counting(pipeline: OfficialPipeline) -> tuple[OfficialPipeline, Counter[str]]:
    """The same pipeline, and the passes of its networks so far."""
    passes: Counter[str] = Counter()
    networks: Any = {
        name: Counted(name, getattr(pipeline.networks, name), passes)
        for name in (*ONCE_PER_SOURCE, "unet")
    }
    tracker = replace(pipeline.tracker, deca=networks["deca"])
    networks = replace(pipeline.networks, **networks)
    return replace(pipeline, networks=networks, tracker=tracker), passes


def test_each_step_runs_the_networks_it_needs(pipeline: OfficialPipeline) -> None:
    """Through the interface of both presets."""
    counted, passes = counting(pipeline)
    preset: Preset[OfficialAvatar] = counted

    def since() -> dict[str, int]:
        """Passes since the last call."""
        counts = dict(passes)
        passes.clear()
        return counts

    image = read_image(PORTRAIT)
    avatar = preset.encode(image)
    assert since() == dict.fromkeys(ONCE_PER_SOURCE, 1)
    preset.render(avatar, Controls(jaw=(0.3, 0, 0), arkit={"mouthSmileLeft": 1.0}))
    assert since() == {"unet": 1}
    face = preset.tracker.track(image)
    assert since() == {"deca": 1}
    pose = drive(preset.head, avatar, face)
    assert since() == {}
    preset.render_coefficients(avatar, *pose)
    assert since() == {"unet": 1}
    preset.paint_many([(avatar, preset.pose(avatar, *pose))] * 2)
    assert since() == {"unet": 2}
    preset.background(avatar)
    assert since() == {}
    counted.drive(avatar, image)
    assert since() == {"deca": 1}


def test_portrait_to_frames(
    pipeline: OfficialPipeline, avatar: OfficialAvatar, tmp_path: Path
) -> None:
    """Encode, save, load, render, drive and sweep."""
    avatar.save(tmp_path / "me.avatar")
    assert (tmp_path / "me.avatar").stat().st_size < 2**20
    loaded = OfficialAvatar.load(tmp_path / "me.avatar")
    assert loaded.crop == avatar.crop
    still = pipeline.render(loaded)
    assert np.array_equal(still.rgb, pipeline.render(avatar).rgb)
    assert still.rgb.shape == (256, 256, 3)
    assert still.rgb.std() > 1

    # The portrait driving itself changes nothing.
    driven = pipeline.drive(loaded, read_image(PORTRAIT))
    assert np.array_equal(pipeline.render_coefficients(loaded, *driven).rgb, still.rgb)
    several = pipeline.paint_many([(loaded, pipeline.pose(loaded, *driven))] * 2)
    assert all(np.array_equal(frame.rgb, still.rgb) for frame in several)

    sweep = [
        pipeline.render(loaded, controls).rgb
        for controls in (
            Controls(shape=np.eye(100)[0] * 2, mode="relative"),
            Controls(expression=np.eye(50)[0] * 2, mode="relative"),
            Controls(jaw=(0.3, 0, 0)),
            Controls(global_rotation=(0, 0.5, 0)),
            Controls(arkit={"jawOpen": 1.0, "mouthSmileLeft": 0.5}),
        )
    ]
    frames = [still.rgb, *sweep]
    assert len({frame.tobytes() for frame in frames}) == len(frames)


def test_command_line(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CVTHEAD_OFFICIAL", str(folder / "model"))
    frames = [{"jaw": [0.1 * i, 0, 0]} for i in range(3)]
    (tmp_path / "talk.json").write_text(json.dumps({"fps": 10, "frames": frames}))
    official = ["--preset", "official"]
    for arguments in (
        ["encode", str(PORTRAIT), *official, "-o", "me.avatar"],
        ["render", "me.avatar", "--jaw", "0.3,0,0", "-o", "jaw.png"],
        ["render", "me.avatar", "--arkit", "jawOpen=0.5", "-o", "arkit.png"],
        ["animate", "me.avatar", *official, "--driving", "talk.json", "-o", "talk.png"],
        ["animate", "me.avatar", *official, "--driving", str(PORTRAIT), "-o", "driven.png"],
        ["sweep", "me.avatar", *official, "--cell", "64", "-o", "sweep.png"],
        ["track", str(PORTRAIT), *official, "--overlay", "mesh.png", "--json", "me.json"],
        ["animate", "me.avatar", *official, "--driving", "me.json", "-o", "again.png"],
    ):
        assert main(arguments) == 0, arguments
        assert Path(arguments[-1]).stat().st_size > 1000
    # What DECA says of the portrait, as a file, is what its picture makes the avatar do.
    again, driven = (read_image(Path(name)).astype(int) for name in ("again.png", "driven.png"))
    assert np.abs(again - driven).mean() < 1
    assert not np.array_equal(read_image(Path("jaw.png")), read_image(Path("driven.png")))


def driving_video(path: Path) -> None:
    """The portrait, then without a face, then the portrait tilted."""
    with Image.open(PORTRAIT) as image:
        close = image.convert("RGB").crop((60, 0, 360, 300))
    tilted = close.rotate(20, fillcolor="white")
    with video_writer(path, size=(300, 300), fps=10) as write:
        for picture in (np.asarray(close), np.full((300, 300, 3), 200, np.uint8), tilted):
            write(np.asarray(picture))


def test_a_video_drives(
    folder: Path,
    avatar: OfficialAvatar,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CVTHEAD_OFFICIAL", str(folder / "model"))
    avatar.save("me.avatar")
    driving_video(Path("driver.mp4"))
    command = ["animate", "me.avatar", "--preset", "official", "--driving", "driver.mp4"]
    command += ["--camera", "driver", "--no-smoothing", "-o"]
    assert main([*command, "absolute"]) == 0
    assert "no face in 1 of 3 frames" in capsys.readouterr().err
    assert main([*command, "relative", "--relative"]) == 0
    assert main(["render", "me.avatar", "--background", "white", "-o", "still.png"]) == 0
    absolute, relative = (
        [read_image(path).astype(int) for path in sorted(Path(name).iterdir())]
        for name in ("absolute", "relative")
    )
    for frames in (absolute, relative):
        assert len(frames) == 3
        assert np.array_equal(frames[0], frames[1]), "the latest pose holds"
        assert np.abs(frames[2] - frames[0]).mean() > 0.1
    # Motion since the first frame is none in it.
    still = read_image(Path("still.png")).astype(int)
    assert np.array_equal(relative[0], still)


def test_a_folder_and_threads_can_be_chosen(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CVTHEAD_OFFICIAL", "/nowhere")
    with pytest.raises(AssetError, match="not in /nowhere"):
        load_preset("official")
    preset = load_preset("official", model=folder / "model", threads=1)
    assert isinstance(preset, OfficialPipeline)
    options = preset.networks.unet.session.get_session_options()
    assert options.intra_op_num_threads == 1
    assert (preset.preset, len(preset.fingerprint)) == ("official", 16)


def test_presets_do_not_mix(
    folder: Path,
    avatar: OfficialAvatar,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    avatar.save("me.avatar")
    assert main(["sweep", "me.avatar", "-o", "out.png"]) == 2
    assert "use --preset official" in capsys.readouterr().err
    monkeypatch.setenv("CVTHEAD_OFFICIAL", str(tmp_path / "nothing"))
    assert main(["render", "me.avatar", "-o", "out.png"]) == 2
    assert "cvthead import-official" in capsys.readouterr().err


def test_expression_moves_expression(pipeline: OfficialPipeline, avatar: OfficialAvatar) -> None:
    """The released demo writes it into shape."""
    wanted = avatar.coefficients.expression + 1
    rest = pipeline.head.rest(avatar.coefficients)
    moved = pipeline.head.expression_basis.sum(axis=2)
    changed = type(avatar.coefficients)(avatar.coefficients.shape, wanted, avatar.coefficients.pose)
    assert np.allclose(pipeline.head.rest(changed) - rest, moved, atol=1e-6)


def test_arkit_goes_through_flame_landmarks(pipeline: OfficialPipeline) -> None:
    table = pipeline.arkit
    assert table.expression.shape == (50, len(ARKIT_NAMES))
    assert np.isfinite(table.expression).all()
    tongue, smile = (
        np.abs(table.to_coefficients({name: 1.0}).expression).max()
        for name in ("tongueOut", "mouthSmileLeft")
    )
    assert tongue < 1e-2 * smile  # it moves no landmark
    assert table.to_coefficients({"jawOpen": 1.0}).joint("jaw")[0] > 0.05
    with pytest.raises(CoefficientsError):
        table.to_coefficients({"jawWide": 1.0})


def test_avatars_are_checked(
    pipeline: OfficialPipeline, avatar: OfficialAvatar, tmp_path: Path
) -> None:
    path = tmp_path / "me.avatar"
    avatar.save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(AvatarFileError):
        OfficialAvatar.load(path)
    with pytest.raises(AvatarFileError):
        OfficialAvatar.load(tmp_path / "none.avatar")
    path.write_bytes(avatar.to_bytes().replace(avatar.fingerprint.encode(), b"0" * 16))
    with pytest.raises(ModelChangedError):
        pipeline.render(OfficialAvatar.load(path))
