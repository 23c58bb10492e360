"""A made-up official release from its files to frames, and what the import refuses."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import made_official
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cvthead.cli.main import main
from cvthead.controls import Controls
from cvthead.errors import AssetError, AvatarFileError, CoefficientsError, ModelChangedError
from cvthead.head.arkit import ARKIT_NAMES
from cvthead.images import read_image
from cvthead.official.avatar import OfficialAvatar
from cvthead.official.flame import from_checkpoint, from_files
from cvthead.official.importer import import_official
from cvthead.official.keys import part, released_shapes
from cvthead.official.manifest import FILES, LICENCES, Manifest
from cvthead.official.pipeline import OfficialPipeline

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A release in ``whole``, its import in ``model``, what the command said in ``said``."""
    base = tmp_path_factory.mktemp("official")
    (base / "whole").mkdir()
    made_official.write_whole(base / "whole", made_official.state(), made_official.tables())
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["import-official", str(base / "whole"), "-o", str(base / "model")]) == 0
    (base / "said").write_text(said.getvalue())
    yield base
    shutil.rmtree(base)  # more than a gigabyte


@pytest.fixture(scope="module")
def pipeline(folder: Path) -> OfficialPipeline:
    return OfficialPipeline.load(folder / "model")


@pytest.fixture(scope="module")
def avatar(pipeline: OfficialPipeline) -> OfficialAvatar:
    return pipeline.encode(read_image(PORTRAIT))


def test_sources_hashes_and_licences_are_recorded(folder: Path) -> None:
    said = (folder / "said").read_text()
    record = json.loads((folder / "model" / "model.json").read_text())
    assert {source["name"] for source in record["sources"]} == {"cvthead.pt", "data/transform.pkl"}
    assert {path.name for path in (folder / "model").iterdir()} == {*FILES, "model.json"}
    assert len(record["licences"]) == len(LICENCES)
    for licence in LICENCES:
        assert licence.licence in said
        assert licence.page in said
    assert said.splitlines()[-1] == str(folder / "model")


def test_separate_files_give_the_same_model(folder: Path, tmp_path: Path) -> None:
    weights, mesh = made_official.state(), made_official.tables()
    made_official.write_parts(tmp_path, weights, mesh, "generic_model.pkl")
    sources = import_official(tmp_path, tmp_path / "model")
    assert len(sources) == 9
    found, expected = Manifest.load(tmp_path / "model"), Manifest.load(folder / "model")
    assert found.sha256 == expected.sha256
    assert found.fingerprint == expected.fingerprint
    shutil.rmtree(tmp_path)


@pytest.mark.parametrize("name", ["generic_model.pkl", "flame2023.pkl"])
def test_flame_2020_and_2023(name: str, tmp_path: Path) -> None:
    tensors = made_official.flame_state()
    made_official.write_flame(tmp_path / name, tensors, wrapped=name == "generic_model.pkl")
    embedding = np.array({k: tensors[k] for k in tensors if k.startswith("full")}, dtype=object)
    np.save(tmp_path / "landmarks.npy", embedding, allow_pickle=True)
    found = from_files(tmp_path / name, tmp_path / "landmarks.npy").arrays()
    for key, value in from_checkpoint(tensors).arrays().items():
        assert np.array_equal(found[key], value), key


def test_portrait_to_frames(
    pipeline: OfficialPipeline, avatar: OfficialAvatar, tmp_path: Path
) -> None:
    """Encode, save, load, render, drive and sweep; each runs the networks it needs, no other."""
    networks = pipeline.networks
    calls: Counter[str] = Counter()
    hooks = []
    for name, module in (
        ("parsing", networks.parsing.net),
        ("hair", networks.hair.hair_model.conv1),
        ("deca", networks.deca),
        ("encoder", networks.network.encoder),
        ("unet", networks.network.unet),
    ):

        def count(_module: nn.Module, _inputs: object, _out: Tensor, name: str = name) -> None:
            calls[name] += 1

        hooks.append(module.register_forward_hook(count))
    try:
        avatar.save(tmp_path / "me.avatar")
        assert (tmp_path / "me.avatar").stat().st_size < 2**20
        loaded = OfficialAvatar.load(tmp_path / "me.avatar")
        still = pipeline.render(loaded)
        assert np.array_equal(still.rgb, pipeline.render(avatar).rgb)
        assert still.rgb.shape == (256, 256, 3)
        assert still.rgb.std() > 1
        assert calls == {"unet": 2}

        calls.clear()
        driven = pipeline.drive(loaded, read_image(PORTRAIT))
        assert calls == {"deca": 1}
        # The portrait driving itself changes nothing.
        assert np.array_equal(pipeline.render_coefficients(loaded, *driven).rgb, still.rgb)
        assert calls == {"deca": 1, "unet": 1}

        calls.clear()
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
        assert calls == {"unet": len(sweep)}
        frames = [still.rgb, *sweep]
        assert len({frame.tobytes() for frame in frames}) == len(frames)
    finally:
        for hook in hooks:
            hook.remove()


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
    ):
        assert main(arguments) == 0, arguments
        assert Path(arguments[-1]).stat().st_size > 1000
    assert not np.array_equal(read_image(Path("jaw.png")), read_image(Path("driven.png")))


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


def test_an_altered_model_is_refused(folder: Path, tmp_path: Path) -> None:
    model = tmp_path / "model"
    model.mkdir()
    for path in (folder / "model").iterdir():
        (model / path.name).symlink_to(path)
    flame = model / "flame.safetensors"
    data = bytearray(flame.read_bytes())
    data[-1] ^= 1
    flame.unlink()
    flame.write_bytes(data)
    with pytest.raises(AssetError, match="not the imported file"):
        OfficialPipeline.load(model)
    with pytest.raises(AssetError, match="not in"):
        OfficialPipeline.load(tmp_path)


def blanks() -> dict[str, Tensor]:
    """A checkpoint of the right shapes that takes no room: every tensor is one number."""
    return {key: torch.zeros(()).expand(shape) for key, shape in released_shapes().items()}


def release(folder: Path, weights: dict[str, Tensor]) -> None:
    torch.save({"model": weights}, folder / "cvthead.pt")


def test_every_wrong_key_is_named(tmp_path: Path) -> None:
    weights = blanks()
    del weights["unet_generator.up_convs.3.norm2.running_var"], weights["hair_model.fc.bias"]
    weights["ae_proj.bias"] = torch.zeros(3)
    weights["autoencoder.net.12.weight"] = torch.zeros(1)
    release(tmp_path, weights)
    with pytest.raises(AssetError) as caught:
        import_official(tmp_path, tmp_path / "model")
    message = str(caught.value)
    assert "4 differences" in message
    for part_of_it in (
        "unet_generator.up_convs.3.norm2.running_var is missing",
        "hair_model.fc.bias is missing",
        "ae_proj.bias has shape (3,), not (256,)",
        "autoencoder.net.12.weight is unknown",
    ):
        assert part_of_it in message
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize(
    ("prefix", "name"),
    [
        ("face_parsing.", "79999_iter.pth"),
        ("hair_model.", "linear_hair.pth"),
        ("deca.E_flame.", "deca_model.tar"),
        ("autoencoder.", "rome.pth"),
        ("deform_basis", "u_full.pt"),
        ("deca.flame.", "generic_model.pkl"),
    ],
)
def test_an_absent_part_is_asked_for_by_its_file(prefix: str, name: str, tmp_path: Path) -> None:
    release(tmp_path, {k: v for k, v in blanks().items() if not k.startswith(prefix)})
    with pytest.raises(AssetError, match=f"{name}.* is not in"):
        import_official(tmp_path, tmp_path / "model")


def test_a_wrong_separate_file(tmp_path: Path) -> None:
    release(tmp_path, {k: v for k, v in blanks().items() if not k.startswith("hair_model.")})
    hair = {key: torch.zeros(()).expand(shape) for key, shape in part("hair_model.").items()}
    hair["fc.weight"] = torch.zeros(61, 1).expand(61, 2048)
    torch.save(hair, tmp_path / "linear_hair.pth")
    with pytest.raises(AssetError, match=r"linear_hair.*fc\.weight has shape \(61, 2048\)"):
        import_official(tmp_path, tmp_path / "model")


class Call:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch REACHED",)


@pytest.mark.parametrize("name", ["cvthead.pt", "transform.pkl"])
def test_malicious_files_are_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    source = tmp_path / "source"
    source.mkdir()
    if name == "cvthead.pt":
        torch.save({"model": blanks(), "epoch": Call()}, source / name)
    else:
        release(source, {**blanks(), "deca.flame.parents": torch.tensor([-1, 0, 1, 1, 1])})
        (source / name).write_bytes(pickle.dumps({"face": Call()}))
    assert main(["import-official", "source", "-o", "model"]) == 2
    assert "system" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"source"}


@pytest.mark.parametrize("arguments", [["nowhere"], ["."], [".", "-o", "missing/model"]])
def test_wrong_folders(
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CVTHEAD_OFFICIAL", str(tmp_path / "data" / "official"))
    assert main(["import-official", *arguments]) == 2
    assert "cvthead: error: " in capsys.readouterr().err
