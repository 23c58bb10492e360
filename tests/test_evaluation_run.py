"""``cvthead evaluate`` from end to end on made-up clips of the sample portrait."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("torch")

from cvthead.cli.main import main
from cvthead.images import encode_image, read_image
from cvthead.runtime.model_folder import packaged
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


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips, of the portrait and of its mirror image, and one still."""
    folder = tmp_path_factory.mktemp("data")
    clips, stills = folder / "clips" / "val", folder / "stills" / "val"
    clips.mkdir(parents=True)
    stills.mkdir(parents=True)
    image = read_image(PORTRAIT)
    for name, picture in (("a", image), ("b", np.ascontiguousarray(image[:, ::-1]))):
        size = image.shape[1], image.shape[0]
        with video_writer(clips / f"{name}.mp4", size=size, fps=25) as write:
            for frame in nodding(picture, FRAMES):
                write(frame.astype(np.uint8))
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
    assert report["absent"] == {"Cross-identity": "it takes two clips with a trackable face"}
    ours = report["tables"]["self-reenactment, paper"]["rows"]["CVTHead, official"]
    assert ours["PSNR ↑"] > 0
    assert report["tables"]["speed"]["rows"]["CVTHead, official"]["FPS, cached ↑"] > 0
    assert set(report["tables"]["turned"]["rows"]) == {
        *("CVTHead, official", "copy source", "coloured mesh")
    }
    page = (tmp_path / "index.html").read_text("utf-8")
    assert all(f"<h2>{heading}</h2>" in page for heading in ("Self-reenactment", "Sweep"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--every", "0"], "--every is 0"),
        (["--model", "nameless"], "no name of its own"),
        (["--preset", "official", "--model", "a=b"], "--model goes with the preset open"),
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
    assert "no usable clips" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
