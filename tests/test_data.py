"""Data preparation: layouts, shards, resuming, and the report."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path, PurePath

import numpy as np
import pytest
from PIL import Image
from webdataset.tariterators import group_by_keys, tar_file_expander

from cvthead.cli.main import main
from cvthead.data.layout import find_items, identity_of, key_of, split_of
from cvthead.data.prepare import Settings, pack, prepare, resume, waiting
from cvthead.data.tracking import Outcome
from cvthead.errors import InputError
from cvthead.training.records import records_hash, stored_records

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"


@pytest.mark.parametrize(
    ("file", "identity"),
    [
        ("dev/mp4/id00012/21Uxsk56VDQ/00001.mp4", "id00012"),
        ("id10001/1zcIwhmdeo4/00002.mp4", "id10001"),
        ("id10280#NXjT3732Ekg#001093#001192.mp4", "id10280"),
        ("test/A.J._Buckley/1.6/abc/1.mp4", "A.J._Buckley"),
        ("me/holiday.mov", "me"),
        ("someone.png", "someone"),
    ],
)
def test_identity_comes_from_the_path(file: str, identity: str) -> None:
    assert identity_of(PurePath(file)) == identity


def test_keys_are_unique_and_without_dots() -> None:
    keys = {key_of(PurePath(f)) for f in ("a/00001.mp4", "b/00001.mp4", "a.b/00001.mp4")}
    assert len(keys) == 3
    assert not any("." in key or "/" in key for key in keys)


def test_split_shares_follow_the_settings() -> None:
    splits = [split_of(f"id{number:05d}", val=0.2, test=0.1) for number in range(2000)]
    assert splits.count("val") == pytest.approx(400, abs=60)
    assert splits.count("test") == pytest.approx(200, abs=50)
    # More validation people take nobody out of validation.
    assert all(
        split_of(f"id{number:05d}", val=0.3, test=0.1) == "val"
        for number, split in enumerate(splits)
        if split == "val"
    )


def test_a_folder_without_media_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no video or still"):
        find_items(tmp_path, val=0.1, test=0.1)
    with pytest.raises(InputError, match="do not fit"):
        find_items(tmp_path, val=0.9, test=0.2)


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two readable stills of one person, one damaged, one without a face, and a text."""
    folder = tmp_path_factory.mktemp("videos")
    (folder / "id10001").mkdir()
    portrait = Image.open(PORTRAIT).convert("RGB")
    portrait.save(folder / "id10001" / "a.png")
    portrait.transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(folder / "id10001" / "b.png")
    (folder / "broken.png").write_bytes(PORTRAIT.read_bytes()[:3000])
    Image.new("RGB", (300, 300), (120, 120, 120)).save(folder / "grey.jpg")
    (folder / "notes.txt").write_text("hello")
    return folder


@pytest.fixture(scope="module")
def prepared(videos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("prepared")
    arguments = ["data", "prepare", str(videos), str(out), "--val", "0", "--test", "0"]
    assert main([*arguments, "--processes", "1", "--shard-size", "1"]) == 0
    return out


def test_report_says_what_was_dropped_and_why(prepared: Path) -> None:
    report = json.loads((prepared / "report.json").read_text())
    assert report["files"] == 5
    assert report["kept"]["train"] == {"records": 2, "frames": 2, "identities": 1}
    assert report["dropped_files"] == {
        "broken.png": "unreadable",
        "grey.jpg": "no face",
        "notes.txt": "not a video or still",
    }


def test_shards_are_webdatasets_and_indexed(prepared: Path) -> None:
    shards = sorted((prepared / "train").glob("*.tar"))
    assert [shard.name for shard in shards] == ["000000.tar", "000001.tar"]
    assert not (prepared / "pending").exists()
    samples: dict[str, dict[str, bytes]] = {}
    for shard in shards:
        with shard.open("rb") as file:  # webdataset's own pipeline leaves files open
            read = group_by_keys(tar_file_expander([{"url": shard.name, "stream": file}]))
            samples |= {sample["__key__"]: sample for sample in read}
    stored = stored_records(prepared / "train")
    assert [record.name for record in stored] == sorted(f"{key}.npz" for key in samples)
    for record in stored:
        sample = samples[record.name.removesuffix(".npz")]
        assert record.read() == sample["npz"]
        assert json.loads(sample["json"])["identity"] == "id10001"
        assert record.open().frame(0).image.shape == (256, 256, 3)


def test_files_and_shards_hold_the_same_records(prepared: Path, tmp_path: Path) -> None:
    for shard in (prepared / "train").glob("*.tar"):
        with tarfile.open(shard) as tar:
            tar.extractall(tmp_path, filter="data")
    assert records_hash(tmp_path) == records_hash(prepared / "train")


def test_a_second_call_does_nothing_and_other_settings_are_refused(
    videos: Path, prepared: Path
) -> None:
    before = {path: path.stat().st_mtime_ns for path in (prepared / "train").iterdir()}
    settings = Settings(val=0, test=0, shard_size=1)
    report = prepare(videos, prepared, settings, processes=1)
    assert report.kept["train"]["records"] == 2
    assert before == {path: path.stat().st_mtime_ns for path in (prepared / "train").iterdir()}
    with pytest.raises(InputError, match="other settings"):
        prepare(videos, prepared, Settings(frames=3), processes=1)


def test_a_shard_without_index_is_refused(prepared: Path, tmp_path: Path) -> None:
    shutil.copy(prepared / "train" / "000000.tar", tmp_path)
    with pytest.raises(InputError, match="index"):
        stored_records(tmp_path)


def test_a_kill_loses_no_finished_file(videos: Path, prepared: Path, tmp_path: Path) -> None:
    """Stops right after the first file is journaled; the next call completes the folder."""
    out = tmp_path / "out"
    arguments = ["data", "prepare", str(videos), str(out), "--val", "0", "--test", "0"]
    command = [sys.executable, "-m", "cvthead.cli.main", *arguments]
    command += ["--processes", "1", "--shard-size", "1"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        journal = out / "journal.jsonl"
        while run.poll() is None and not (
            journal.exists() and len(journal.read_text().splitlines()) > 1
        ):
            time.sleep(0.01)
        run.send_signal(signal.SIGKILL)
    assert run.returncode == -signal.SIGKILL
    with journal.open("a") as file:
        file.write('{"key": "cut o')  # as a kill in mid-write leaves it
    assert main([*arguments, "--processes", "1", "--shard-size", "1"]) == 0
    assert records_hash(out / "train") == records_hash(prepared / "train")
    whole, resumed = (sorted((folder / "train").glob("*.tar")) for folder in (prepared, out))
    assert [s.read_bytes() for s in whole] == [s.read_bytes() for s in resumed]


def test_a_kill_between_shard_and_clean_up_packs_nothing_twice(tmp_path: Path) -> None:
    settings = Settings(val=0, test=0)
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "a.png").write_bytes(b"")
    items, _ = find_items(tmp_path / "videos", val=0, test=0)
    (tmp_path / "train").mkdir()
    (tmp_path / "pending").mkdir()
    done = {items[0].key: Outcome(frames=1)}
    pending = tmp_path / "pending" / f"{items[0].key}.npz"
    np.savez(pending, pose=np.zeros((1, 15)))
    record = pending.read_bytes()
    assert waiting(tmp_path, "train", items, done) == items
    pack(tmp_path, "train", items, done, settings)
    pending.write_bytes(record)
    assert waiting(tmp_path, "train", items, done) == []
    assert not pending.exists()
    assert resume(tmp_path, settings) == {}
