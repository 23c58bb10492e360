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

import cv2
import numpy as np
import pytest
from PIL import Image
from webdataset.tariterators import group_by_keys, tar_file_expander

from cvthead.cli.main import main
from cvthead.data.layout import SPLITS, find_items, identity_of, key_of, split_of
from cvthead.data.prepare import Settings, pack, prepare, resume, waiting
from cvthead.data.tracking import Outcome
from cvthead.errors import InputError
from cvthead.images import read_image
from cvthead.training.records import records_hash, stored_records
from cvthead.video_writer import video_writer

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
        with tarfile.open(shard) as tar:  # extractall takes a filter from Python 3.11.4 on alone
            for member in tar:
                file = tar.extractfile(member)
                assert file is not None
                (tmp_path / member.name).write_bytes(file.read())
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


def kill_after_first_file(arguments: list[str], out: Path) -> None:
    """Run the command until the first file is journaled."""
    command = [sys.executable, "-m", "cvthead.cli.main", *arguments]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        journal = out / "journal.jsonl"
        while run.poll() is None and not (
            journal.exists() and len(journal.read_text().splitlines()) > 1
        ):
            time.sleep(0.01)
        run.send_signal(signal.SIGKILL)
    assert run.returncode == -signal.SIGKILL


def test_a_kill_loses_no_finished_file(videos: Path, prepared: Path, tmp_path: Path) -> None:
    """Stops right after the first file is journaled; the next call completes the folder."""
    out = tmp_path / "out"
    arguments = ["data", "prepare", str(videos), str(out), "--val", "0", "--test", "0"]
    arguments += ["--processes", "1", "--shard-size", "1"]
    kill_after_first_file(arguments, out)
    with (out / "journal.jsonl").open("a") as file:
        file.write('{"key": "cut o')  # as a kill in mid-write leaves it
    assert main(arguments) == 0
    assert records_hash(out / "train") == records_hash(prepared / "train")
    whole, resumed = (sorted((folder / "train").glob("*.tar")) for folder in (prepared, out))
    assert [s.read_bytes() for s in whole] == [s.read_bytes() for s in resumed]


FRAMES = 6  # sampled from each clip of 8


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A person of each split in a clip of 8 frames, in which the head moves to the right and
    nods."""
    folder = tmp_path_factory.mktemp("clips")
    image = read_image(PORTRAIT)
    size = image.shape[1], image.shape[0]
    for split in SPLITS:
        people = (f"id{number:05d}" for number in range(1000))
        person = next(one for one in people if split_of(one, val=0.3, test=0.3) == split)
        path = folder / person / "x" / "00001.mp4"
        path.parent.mkdir(parents=True)
        with video_writer(path, size=size, fps=25) as write:
            for step in range(8):
                turn = cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), 0.5 * step, 1)
                turn[0, 2] += 4 * step
                frame = cv2.warpAffine(image, turn, size, borderMode=cv2.BORDER_REPLICATE)
                write(frame.astype(np.uint8))
    return folder


CLIP_OPTIONS = ["--crop", "clip", "--frames", str(FRAMES), "--val", "0.3", "--test", "0.3"]
CLIP_OPTIONS += ["--processes", "2"]


@pytest.fixture(scope="module")
def prepared_clips(clips: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made by two processes, in two calls: the first is killed."""
    out = tmp_path_factory.mktemp("prepared_clips")
    arguments = ["data", "prepare", str(clips), str(out), *CLIP_OPTIONS]
    kill_after_first_file(arguments, out)
    finished = len((out / "journal.jsonl").read_text().splitlines()) - 1
    assert 0 < finished < len(SPLITS)
    assert main(arguments) == 0
    return out


def test_videos_of_every_split_become_records(clips: Path, prepared_clips: Path) -> None:
    report = json.loads((prepared_clips / "report.json").read_text())
    one = {"records": 1, "frames": FRAMES, "identities": 1}
    assert report["kept"] == dict.fromkeys(SPLITS, one)
    items, _ = find_items(clips, val=0.3, test=0.3)
    assert {item.split for item in items} == set(SPLITS)
    for item in items:
        (stored,) = stored_records(prepared_clips / item.split)
        assert stored.frames == stored.open().frames == FRAMES
        (shard,) = (prepared_clips / item.split).glob("*.tar")
        with tarfile.open(shard) as tar:
            file = tar.extractfile(f"{item.key}.json")
            assert file is not None
            assert json.load(file) == {
                "file": item.file.as_posix(),
                "identity": item.identity,
                "split": item.split,
                "frames": FRAMES,
                "crop": "clip",
            }


def test_an_interrupted_call_does_every_video_once(clips: Path, prepared_clips: Path) -> None:
    _, *lines = (prepared_clips / "journal.jsonl").read_text().splitlines()
    items, _ = find_items(clips, val=0.3, test=0.3)
    assert sorted(json.loads(line)["key"] for line in lines) == sorted(item.key for item in items)
    assert not (prepared_clips / "pending").exists()


def test_the_crop_stays_within_a_clip_and_the_head_moves_in_it(prepared_clips: Path) -> None:
    """A fixed crop leaves the head's own motion to the camera and the pixels outside the video
    where they are; the head crop would cancel the one and move the others."""
    (stored,) = stored_records(prepared_clips / "train")
    record = stored.open()
    frames = [record.frame(number) for number in range(record.frames)]
    assert all((frame.valid == frames[0].valid).all() for frame in frames)
    shifts = np.array([frame.camera.tx for frame in frames])
    assert (np.diff(shifts) > 0).all()
    scales = np.array([frame.camera.scale for frame in frames])
    assert np.ptp(scales) < 0.05 * scales.mean()


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
