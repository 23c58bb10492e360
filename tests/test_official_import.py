"""A made-up official release from its files to frames, and what the import refuses."""

from __future__ import annotations

import json
import os
import pickle
import pickletools
import shutil
from pathlib import Path
from typing import Any

import made_official
import numpy as np
import pytest
import torch
from made_official import earlier_import
from safetensors.torch import load_file
from scipy.sparse import csc_matrix
from torch import Tensor

from cvthead.cli.main import main
from cvthead.errors import AssetError, InputError
from cvthead.official.flame import (
    Flame,
    from_checkpoint,
    from_files,
    read_landmarks,
    read_model,
)
from cvthead.official.importer import import_official, read_release
from cvthead.official.keys import part, released_shapes
from cvthead.official.manifest import (
    EIGHT_BIT,
    FILES,
    LICENCES,
    RECORD,
    WEIGHTS,
    Manifest,
)
from cvthead.official.mesh import read_hierarchy
from cvthead.official.pipeline import OfficialPipeline

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"


@pytest.fixture
def folder(official_folder: Path) -> Path:
    return official_folder


def test_sources_hashes_and_licences_are_recorded(folder: Path) -> None:
    said = (folder / "said").read_text()
    record = json.loads((folder / "model" / "model.json").read_text())
    assert {source["name"] for source in record["sources"]} == {"cvthead.pt", "data/transform.pkl"}
    names = {path.name for path in (folder / "model").iterdir()}
    assert names - set(EIGHT_BIT.values()) == {*FILES, RECORD}
    assert len(record["licences"]) == len(LICENCES)
    for licence in LICENCES:
        assert licence.licence in said
        assert licence.page in said
    assert said.splitlines()[-1] == str(folder / "link")


def test_separate_files_give_the_same_model(folder: Path, tmp_path: Path) -> None:
    weights, mesh = made_official.state(), made_official.tables()
    made_official.write_parts(tmp_path, weights, mesh, "generic_model.pkl")
    files, sources = read_release(tmp_path)
    assert len(sources) == 9
    for name in WEIGHTS:
        expected = load_file(folder / "model" / name)
        assert files[name].keys() == expected.keys()
        for key, value in files[name].items():
            assert torch.equal(value, expected[key]), key
    shutil.rmtree(tmp_path)


def read_flame(model: Path, landmarks: Path) -> Flame:
    return from_files(read_model(model), read_landmarks(landmarks))


@pytest.mark.parametrize("year", [2020, 2023])
def test_flame_2020_and_2023(year: int, tmp_path: Path) -> None:
    """Both layouts give the tables that the checkpoint would have had."""
    tensors = made_official.flame_state()
    made_official.write_flame(tmp_path / "flame.pkl", tensors, year=year)
    made_official.write_landmarks(tmp_path / "landmarks.npy", tensors)
    found = read_flame(tmp_path / "flame.pkl", tmp_path / "landmarks.npy").arrays()
    for key, value in from_checkpoint(tensors).arrays().items():
        assert np.array_equal(found[key], value), key


def test_the_released_landmark_file(shared: Path, tmp_path: Path) -> None:
    """It also holds PyTorch tensors, which are not wanted and not loaded."""
    made_official.write_flame(tmp_path / "flame.pkl", made_official.flame_state(), year=2020)
    released = shared / "reference" / "official-data" / "landmark_embedding.npy"
    found = read_flame(tmp_path / "flame.pkl", released)
    assert len(np.unique(found.landmark_faces)) > 60
    np.testing.assert_allclose(found.landmark_bary.sum(axis=1), 1, atol=1e-6)


def test_the_layouts_differ_as_the_files_do(tmp_path: Path) -> None:
    """Or the test above would read the same file twice."""
    for year in (2020, 2023):
        made_official.write_flame(tmp_path / str(year), made_official.flame_state(), year=year)
    old, new = (
        {(o.name, a) for o, a, _ in pickletools.genops((tmp_path / str(y)).read_bytes())}
        for y in (2020, 2023)
    )
    for name in ("chumpy.ch Ch", "__builtin__ set"):
        assert ("GLOBAL", name) in old
    assert not [argument for _, argument in new if "chumpy" in str(argument)]


def test_everything_wrong_with_a_head_model_is_named(tmp_path: Path) -> None:
    path = tmp_path / "flame.pkl"
    made_official.write_flame(path, made_official.flame_state(), year=2023)
    tables = pickle.loads(path.read_bytes())
    del tables["posedirs"]
    tables["v_template"][7] = np.nan
    tables["f"][3] = 5023
    tables |= {"shapedirs": np.zeros((5023, 3, 150)), "weights": "none", "J_regressor": [1, 2]}
    tables["kintree_table"] = np.zeros((2, 5), np.int64)
    path.write_bytes(pickle.dumps(tables))
    with pytest.raises(AssetError) as caught:
        read_model(path)
    assert listed(caught.value, 7) == [
        "posedirs is missing",
        "shapedirs has shape (5023, 3, 150), not (5023, 3, 400)",
        "J_regressor has shape (), not (5, 5023)",
        "weights has shape (), not (5023, 5)",
        "f points outside 0..5022",
        "v_template holds NaN or infinity",
        "the joints are not global, neck, jaw and two eyes",
    ]


def listed(error: AssetError, count: int) -> list[str]:
    """The differences of a file that has so many."""
    return str(error).split(f"({count} differences): ")[1].split("; ")


def test_everything_wrong_with_a_landmark_file_is_named(tmp_path: Path) -> None:
    # As an array it is expected, as a tensor not read.
    tensors: dict[str, Any] = made_official.flame_state()
    tensors["full_lmk_faces_idx"] = torch.zeros(1, 68)
    tensors["lmk_bary_coords"] = np.zeros((50, 3))
    made_official.write_landmarks(tmp_path / "landmarks.npy", tensors)
    with pytest.raises(AssetError) as caught:
        read_landmarks(tmp_path / "landmarks.npy")
    assert listed(caught.value, 2) == [
        "static_lmk_bary_coords has shape (50, 3), not (51, 3)",
        "full_lmk_faces_idx has shape (), not (1, 68)",
    ]


def test_everything_wrong_with_the_transforms_is_named(tmp_path: Path) -> None:
    """Also of the levels that the network does not use."""
    tables = made_official.tables()
    del tables["vertices"][4]
    tables["face"][3] = tables["face"][3][:-1]
    tables["face"][0][5] = 5023
    tables["down_transform"][0] = tables["down_transform"][0] * 2
    tables["up_transform"][1] = csc_matrix((1256, 314))
    tables["up_transform"].append(csc_matrix((20, 5)))
    path = tmp_path / "transform.pkl"
    path.write_bytes(pickle.dumps(tables))
    with pytest.raises(AssetError) as caught:
        read_hierarchy(path)
    assert listed(caught.value, 6) == [
        "vertices[4] is missing",
        "up_transform[4] is unknown",
        "face[3] has shape (138, 3), not (139, 3)",
        "face[0] points outside 0..5022",
        "down_transform[0] does not select one vertex a row",
        "up_transform[1] does not weigh 3 vertices a row",
    ]


def small_release(folder: Path) -> Path:
    """A release that is refused only after its checkpoint was read: ``transform.pkl`` is not."""
    folder.mkdir()
    release(folder, {**blanks(), "deca.flame.parents": torch.tensor([-1, 0, 1, 1, 1])})
    (folder / "transform.pkl").write_bytes(b"damaged")
    return folder


def test_replacing_an_import(folder: Path) -> None:
    """As the fixture did, in a folder that was named by a link."""
    model = folder / "model"
    assert "replace it with --replace" in (folder / "refused").read_text()
    assert Manifest.load(model).fingerprint != Manifest.load(folder / "earlier").fingerprint
    assert {path.name for path in folder.iterdir()} == {
        *("whole", "said", "refused", "earlier", "model", "link")
    }
    assert (folder / "link").is_symlink()


def test_a_failed_replacement_leaves_the_earlier_import(tmp_path: Path) -> None:
    model = earlier_import(tmp_path / "model")
    before = {path.name: path.read_bytes() for path in model.iterdir()}
    with pytest.raises(AssetError, match=r"transform\.pkl is refused"):
        import_official(small_release(tmp_path / "release"), model, replace=True)
    assert {path.name: path.read_bytes() for path in model.iterdir()} == before
    assert {path.name for path in tmp_path.iterdir()} == {"model", "release"}


def test_only_an_import_is_replaced(tmp_path: Path) -> None:
    model = earlier_import(tmp_path / "model")
    (model / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match=r"holds more than an import: thesis\.txt"):
        import_official(small_release(tmp_path / "release"), model, replace=True)
    assert (model / "thesis.txt").read_text() == "mine"


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


def test_decas_other_networks_are_checked_where_they_are(tmp_path: Path) -> None:
    release(tmp_path, {k: v for k, v in blanks().items() if not k.startswith("deca.E_flame.")})
    contents = made_official.deca(blanks())
    del contents["E_detail"], contents["D_detail"]["l1.0.bias"]
    contents["E_flame"]["layers.2.bias"] = torch.zeros(235)
    torch.save(contents, tmp_path / "deca_model.tar")
    with pytest.raises(AssetError) as caught:
        import_official(tmp_path, tmp_path / "model")
    listed = str(caught.value)
    for line in (
        "deca_model.tar is not the released file (2 differences)",
        "D_detail.l1.0.bias is missing",
        "E_flame.layers.2.bias has shape (235,), not (236,)",
    ):
        assert line in listed


def test_the_problems_of_all_files_are_listed_in_one_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = ("ae_proj.", "patch_to_embedding.", "vtx_", "transformer.", "unet_generator.", "pos_")
    weights = {key: value for key, value in blanks().items() if key.startswith(kept)}
    del weights["ae_proj.bias"]
    release(tmp_path, weights)
    (tmp_path / "79999_iter.pth").write_bytes(b"damaged")
    torch.save({"fc.weight": torch.zeros(1)}, tmp_path / "linear_hair.pth")
    torch.save({"E_flame": {"epoch": 3}}, tmp_path / "deca_model.tar")
    torch.save({"model": torch.zeros(1)}, tmp_path / "mean_deform.pt")
    (tmp_path / "generic_model.pkl").write_bytes(pickle.dumps(["no tables"]))
    np.save(tmp_path / "landmark_embedding.npy", np.zeros(3))
    (tmp_path / "transform.pkl").write_bytes(pickle.dumps({"face": Call()}))
    with pytest.raises(AssetError) as caught:
        import_official(tmp_path, tmp_path / "model")
    first, *problems = str(caught.value).splitlines()
    assert first == f"10 problems with the files in {tmp_path}:"
    for problem, (name, what) in zip(
        problems,
        (
            ("cvthead.pt", "(1 difference): ae_proj.bias is missing"),
            ("79999_iter.pth", "is refused: Unsupported operand"),
            ("linear_hair.pth", "(320 differences): conv1.weight is missing; "),
            ("deca_model.tar", "holds no named tensors under epoch"),
            ("rome.pth", "is not in"),
            ("mean_deform.pt", "holds no tensor"),
            ("u_full.pt", "is not in"),
            ("generic_model.pkl", "holds no named tables"),
            ("landmark_embedding.npy", "no single object"),
            ("transform.pkl", "it names posix.system"),
        ),
        strict=True,
    ):
        assert name in problem
        assert what in problem
    assert main(["import-official", str(tmp_path), "-o", str(tmp_path / "model")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(f"({number}) " in line for number in range(1, 11))
    assert not (tmp_path / "model").exists()


def test_without_a_checkpoint_the_other_files_are_still_checked(tmp_path: Path) -> None:
    """Those that are not there may not be needed: that is the checkpoint's to say."""
    torch.save({"fc.weight": torch.zeros(1)}, tmp_path / "linear_hair.pth")
    (tmp_path / "generic_model.pkl").write_bytes(b"damaged")
    with pytest.raises(AssetError) as caught:
        import_official(tmp_path, tmp_path / "model")
    _, *problems = str(caught.value).splitlines()
    for problem, what in zip(
        problems,
        ("cvthead.pt is not in", "fc.bias is missing", "is refused", "transform.pkl is not in"),
        strict=True,
    ):
        assert what in problem


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
