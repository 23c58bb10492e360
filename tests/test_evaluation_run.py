"""``cvthead evaluate`` from end to end on made-up clips of the sample portrait."""

from __future__ import annotations

import json
import re
import shutil
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("torch")

from made_networks import distance, features

from cvthead.cli.evaluate import or_absent
from cvthead.cli.main import main
from cvthead.data.layout import SPLITS, find_items, split_of
from cvthead.data.prepare import Settings
from cvthead.errors import InputError
from cvthead.evaluation.methods import trained
from cvthead.evaluation.shots import shoot
from cvthead.evaluation.videos import find_videos
from cvthead.images import encode_image, read_image
from cvthead.official.manifest import RECORD, Manifest, write_manifest
from cvthead.official.painted import HARD_MASK
from cvthead.official.pipeline import OfficialPipeline
from cvthead.pipeline import Pipeline
from cvthead.runtime.model_folder import packaged
from cvthead.training.perceptual import SHA256, STLPIPS
from cvthead.video_writer import video_writer

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"
FRAMES = 14
COUNTS = ["--drivers", "1", "--crossings", "1", "--runs", "1", "--people", "1"]


def nodding(image: np.ndarray, count: int) -> list[np.ndarray]:
    """The picture tilted a little more in every frame."""
    size = image.shape[1], image.shape[0]
    turns = [
        cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), 0.4 * step, 1) for step in range(count)
    ]
    return [cv2.warpAffine(image, turn, size, borderMode=cv2.BORDER_REPLICATE) for turn in turns]


def save_clip(path: Path, image: np.ndarray, count: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with video_writer(path, size=(image.shape[1], image.shape[0]), fps=25) as write:
        for frame in nodding(image, count):
            write(frame.astype(np.uint8))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips, of the portrait and of its mirror image, and one still."""
    folder = tmp_path_factory.mktemp("data")
    clips, stills = folder / "clips" / "val", folder / "stills" / "val"
    stills.mkdir(parents=True)
    image = read_image(PORTRAIT)
    for name, picture in (("a", image), ("b", np.ascontiguousarray(image[:, ::-1]))):
        save_clip(clips / f"{name}.mp4", picture, FRAMES)
    (stills / "s.jpg").write_bytes(encode_image(image, "jpeg"))
    (folder / "stills.csv").write_text(
        "file,split,set,group\nstills/val/s.jpg,val,made,female/white\n"
    )
    return folder


def test_evaluate_writes_tables_and_pictures(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    assert main(["evaluate", "--data", str(data), "-o", str(output), *COUNTS]) == 0

    whole = json.loads((output / "report.json").read_text("utf-8"))
    report = whole["tables"]
    markdown = (output / "report.md").read_text("utf-8")
    assert markdown in capsys.readouterr().out
    assert "2 clips, 2 driving frames" in markdown

    score = report["self-reenactment"]["rows"]
    assert set(score) == {"CVTHead", "copy source", "coloured mesh", "coloured mesh, bald"}
    # The driver is the source but for a small tilt.
    assert score["CVTHead"]["PSNR ↑"] > 18
    assert score["coloured mesh, bald"]["PSNR ↑"] < score["coloured mesh"]["PSNR ↑"]
    assert list(whole["absent"]) == ["Big poses"]
    assert "Big poses: absent, no clip has two frames" in markdown
    assert "big poses" not in report
    assert report["self-reenactment, paper"]["rows"]["CVTHead"]["LPIPS ↓"] is None

    cross = report["cross-identity"]["rows"]
    assert cross["CVTHead"]["lost ↓"] == 0
    assert cross["CVTHead"]["pose error, degrees ↓"] < 8
    assert report["turned"]["rows"]["CVTHead"]["lost ↓"] <= 4
    assert report["two sources"]["rows"]["copy source"]["PSNR ↑"] > 15
    fps = report["speed"]["rows"]
    assert 0 < fps["CVTHead"]["FPS ↑"] < fps["CVTHead"]["FPS, cached ↑"]
    assert fps["CVTHead, paper"] == {"FPS ↑": 24.3, "FPS, cached ↑": None}
    table = report["cross-identity, paper"]["rows"]
    assert table["CVTHead"]["FPS ↑"] == fps["CVTHead"]["FPS ↑"]
    assert table["CVTHead, paper, VoxCeleb1"]["FID ↓"] == 25.78
    assert set(report["groups, CVTHead"]["rows"]) == {"female/white", "all"}
    assert report["steadiness"]["rows"]["CVTHead"]["flicker on still coefficients"] > 0

    page = (output / "index.html").read_text("utf-8")
    for heading in ("Self-reenactment", "Cross-identity", "Turned", "Sweep"):
        assert f"<h2>{heading}</h2>" in page
    images = {path.name for path in (output / "images").iterdir()}
    assert all(f"images/{name}" in page for name in images)
    assert "self-reenactment-0-1-1.jpg" in images


def test_models_are_compared_in_one_table(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bald = tmp_path / "bald"
    shutil.copytree(packaged("open"), bald)
    record = json.loads((bald / "model.json").read_text("utf-8"))
    record["training"]["deformation"] = "false"
    (bald / "model.json").write_text(json.dumps(record), encoding="utf-8")
    models = ["--model", f"A={packaged('open')}", "--model", f"B={bald}", "--without-deformation"]
    command = ["evaluate", "--data", str(data), "-o", str(tmp_path), "--only", "self", *models]
    assert main([*command, "--every", "2", *COUNTS]) == 0
    tables = json.loads((tmp_path / "report.json").read_text("utf-8"))["tables"]
    names = ["A", "B", "A, no deformation"]
    assert list(tables["unseen"]["rows"])[:3] == names
    rows = tables["self-reenactment"]["rows"]
    assert list(rows)[:3] == names
    assert rows["B"] == rows["A, no deformation"] != rows["A"]
    assert "| A, no deformation |" in capsys.readouterr().out


def test_the_official_preset_is_evaluated(
    data: Path, tmp_path: Path, official_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one clip and made-up weights; what needs two clips is named as absent."""
    monkeypatch.setenv("CVTHEAD_OFFICIAL", str(official_folder / "model"))
    parts = [word for part in ("self", "cross", "speed") for word in ("--only", part)]
    command = ["evaluate", "--data", str(data), "-o", str(tmp_path), "--preset", "official"]
    assert main([*command, *parts, "--every", "2", *COUNTS]) == 0
    report = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert report["absent"] == {
        "Cross-identity": "it takes clips of two people with a trackable face"
    }
    # As the released evaluation composites, all columns by the results' own masks.
    ours, own, target = (
        report["tables"][f"self-reenactment{which}"]["rows"]["CVTHead, official"]
        for which in (", paper", ", own masks", "")
    )
    assert all(ours[figure] == own[figure] != target[figure] for figure in ("PSNR ↑", "MS-SSIM ↑"))
    assert report["tables"]["speed"]["rows"]["CVTHead, official"]["FPS, cached ↑"] > 0
    assert set(report["tables"]["turned"]["rows"]) == {
        *("CVTHead, official", "copy source", "coloured mesh")
    }
    page = (tmp_path / "index.html").read_text("utf-8")
    assert all(f"<h2>{heading}</h2>" in page for heading in ("Self-reenactment", "Sweep"))


def test_official_models_are_compared_in_one_table(
    data: Path, tmp_path: Path, official_folder: Path
) -> None:
    """The second one says of itself that it was retrained without hair and shoulders."""
    imported, bald = official_folder / "model", tmp_path / "bald"
    bald.mkdir()
    for path in imported.iterdir():
        (bald / path.name).symlink_to(path)
    (bald / RECORD).unlink()
    manifest = Manifest.load(imported)
    write_manifest(bald, manifest.sources, manifest.psnr, deformation=False)
    models = ["--model", f"A={imported}", "--model", f"B={bald}", "--without-deformation"]
    command = ["evaluate", "--data", str(data), "-o", str(tmp_path / "out"), "--only", "self"]
    options = ["--preset", "official", "--every", "2", *models, *COUNTS]
    assert main([*command, *options]) == 0
    tables = json.loads((tmp_path / "out" / "report.json").read_text("utf-8"))["tables"]
    rows = tables["self-reenactment, own masks"]["rows"]
    assert list(rows)[:3] == ["A", "B", "A, no deformation"]
    assert rows["B"] == rows["A, no deformation"] != rows["A"]


def test_official_results_have_the_hard_mask(official_folder: Path, pipeline: Pipeline) -> None:
    official = OfficialPipeline.load(official_folder / "model")
    source = shoot(pipeline.tracker, "source", 0, read_image(PORTRAIT))
    assert source is not None
    person = trained(official)(source)
    drawn = person.draw(person.coefficients, person.camera)
    avatar = official.encode(source.image)
    released = official.white(avatar, avatar.coefficients, avatar.camera, threshold=HARD_MASK)
    assert set(np.unique(drawn.alpha)) == {0, 1}
    # The released code truncates colours to bytes.
    assert np.abs(drawn.on_white.astype(int) - released).max() <= 1
    soft = official.white(avatar, avatar.coefficients, avatar.camera)
    assert np.abs(drawn.on_white.astype(int) - soft).max() > 50
    ours = trained(pipeline)(source)
    alpha = ours.draw(ours.coefficients, ours.camera).alpha
    assert ((alpha > 0.1) & (alpha < 0.9)).any()


@pytest.fixture(scope="module")
def voxceleb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three clips of two people in VoxCeleb's layout; one more that is damaged, and a still."""
    folder = tmp_path_factory.mktemp("voxceleb")
    image = read_image(PORTRAIT)
    mirrored = np.ascontiguousarray(image[:, ::-1])
    clips = {"id10001/x": image, "id10001/y": nodding(image, 9)[-1], "id10002/z": mirrored}
    for place, picture in clips.items():
        save_clip(folder / place / "00001.mp4", picture, 4)
    (folder / "id10002" / "z" / "00002.mp4").write_bytes(b"no video")
    (folder / "id10003.png").write_bytes(PORTRAIT.read_bytes())
    return folder


@pytest.fixture(scope="module")
def evaluated(voxceleb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The three clips measured with user networks, and without the weights of ST-LPIPS."""
    pytest.importorskip("torchmetrics")
    folder = tmp_path_factory.mktemp("evaluated")
    networks = {
        "lpips": distance(folder / "lpips.onnx"),
        "fid": features(folder / "fid.onnx", 4),
        "csim": features(folder / "csim.onnx", 8, size=112),
        "iqa": features(folder / "iqa.onnx", 1),
    }
    options = [word for name, path in networks.items() for word in (f"--{name}-network", str(path))]
    options += [word for part in ("self", "cross", "sources") for word in ("--only", part)]
    counts = ["--drivers", "1", "--crossings", "3", "--people", "3"]
    with pytest.MonkeyPatch.context() as patch:
        # No file has this hash, and none can be downloaded.
        patch.setitem(SHA256, "alex", "0" * 64)
        patch.setenv("CVTHEAD_CACHE", str(folder / "cache"))
        patch.setenv("PIP_NO_INDEX", "1")
        command = ["evaluate", "--data", str(voxceleb), "-o", str(folder), *options, *counts]
        assert main(command) == 0
    return folder


def test_clips_of_one_person_never_drive_each_other(voxceleb: Path, evaluated: Path) -> None:
    items, _ = find_items(voxceleb, val=0, test=0)
    identity = {item.key: item.identity for item in items}
    page = (evaluated / "index.html").read_text("utf-8")
    grids = page.split("<h2>Cross-identity</h2>")[-1].split("<h2>")[0].split("<h3>")[1:]
    driven = {grid.split("</h3>")[0]: re.findall(r"<th>([^<,]+), \d+</th>", grid) for grid in grids}
    # Each clip lends two frames; three of all four others would include the same person.
    assert sorted(len(drivers) for drivers in driven.values()) == [2, 2, 3]
    for source, drivers in driven.items():
        assert identity[source] not in {identity[driver] for driver in drivers}
    caption = json.loads((evaluated / "report.json").read_text("utf-8"))["tables"]["cross-identity"]
    assert "7 pairs of different people" in caption["caption"]


def test_clips_of_equal_file_names_are_told_apart(evaluated: Path) -> None:
    report = json.loads((evaluated / "report.json").read_text("utf-8"))
    assert report["about"][0].startswith("3 clips of 2 people, 3 driving frames.")
    assert len(report["tables"]["self-reenactment"]["clips"]["CVTHead"]) == 3
    assert "images/self-reenactment-2-0-0.jpg" in (evaluated / "index.html").read_text("utf-8")


def test_the_papers_tables_are_full_with_the_users_networks(evaluated: Path) -> None:
    tables = json.loads((evaluated / "report.json").read_text("utf-8"))["tables"]
    own, cross = (tables[f"{key}, paper"]["rows"] for key in ("self-reenactment", "cross-identity"))
    assert all(None not in own[name].values() for name in ("CVTHead", "copy source"))
    assert 0 < own["CVTHead"]["LPIPS ↓"] < 0.5
    for name in ("CVTHead", "copy source", "coloured mesh"):
        # No part "speed" was asked for.
        assert [title for title, figure in cross[name].items() if figure is None] == ["FPS ↑"]
        assert cross[name]["CSIM ↑"] <= 1
    # Features of the sources' own pictures are the nearest to the sources' features.
    assert cross["copy source"]["FID ↓"] < cross["CVTHead"]["FID ↓"]


def test_without_weights_st_lpips_is_absent_and_the_rest_is_there(evaluated: Path) -> None:
    tables = json.loads((evaluated / "report.json").read_text("utf-8"))["tables"]
    for key in ("self-reenactment", "two sources"):
        figures = tables[key]["rows"]["CVTHead"]
        assert [title for title, figure in figures.items() if figure is None] == ["ST-LPIPS ↓"]
    assert "| absent |" in (evaluated / "report.md").read_text("utf-8")


def test_missing_weights_are_a_warning_that_names_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SHA256, "alex", "0" * 64)
    monkeypatch.setenv("CVTHEAD_CACHE", str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.warns(UserWarning, match=r"ST-LPIPS is absent: .*; pip install --no-deps"):
        assert or_absent("ST-LPIPS", partial(STLPIPS, "alex")) is None


def test_the_people_held_out_are_those_of_data_prepare(tmp_path: Path) -> None:
    people = [f"id{number:05d}" for number in range(200)]
    for person in people:
        (tmp_path / person).mkdir()
        (tmp_path / person / "00001.mp4").touch()
        (tmp_path / person / "00001.png").touch()
    settings = Settings()
    found = {split: find_videos(tmp_path, split) for split in SPLITS}
    for split, videos in found.items():
        wanted = [p for p in people if split_of(p, val=settings.val, test=settings.test) == split]
        assert [video.identity for video in videos] == wanted
        assert len(wanted) > 2
    everybody = find_videos(tmp_path, None)
    assert len({video.name for video in everybody}) == len(everybody) == 200


def test_a_split_that_is_not_there_is_refused(data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="held out as a whole"):
        find_videos(data, "test")
    assert split_of("anna", val=0.05, test=0.05) != "val"
    (tmp_path / "anna.mp4").touch()
    with pytest.raises(InputError, match="no video of the split val"):
        find_videos(tmp_path, "val")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--every", "0"], "--every is 0"),
        (["--split", "dev"], "invalid choice: 'dev'"),
        (["--model", "nameless"], "no name of its own"),
        (["--model", "a=b", "--model", "a=c"], "no name of its own"),
        (["--preset", "official", "--model", "a=b"], "the official model is not in b"),
        (["--iqa-network", "none.onnx"], "none.onnx cannot be opened"),
    ],
)
def test_wrong_options_end_with_one_line(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "--data", str(tmp_path), *options]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert message in lines[0]


def test_a_folder_without_clips_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "--data", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "no video or still" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
