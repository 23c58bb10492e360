"""Videos and stills -> sharded training records: in parallel, and resumable after a kill.

Output folder::

    train/000000.tar, 000000.json, ...    also val/ and test/; see cvthead.data.shards
    report.json                           what was kept, and what was dropped and why
    journal.jsonl                         one line per finished file
    pending/                              records that wait for a shard; gone at the end

A file is journaled after its record lies in ``pending``, and a record leaves ``pending`` after
its shard is complete. So a kill at any moment costs the files in work at most, and no shard is
ever half written.
"""

from __future__ import annotations

import json
import signal
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from multiprocessing import get_context, parent_process
from os import _exit
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cvthead.data.layout import SPLITS, TEST, VAL, Item, Split, find_items
from cvthead.data.official import make_official_record
from cvthead.data.report import Report
from cvthead.data.shards import write_shard
from cvthead.data.tracking import CropStyle, Outcome, make_record
from cvthead.deformation import DeformationModel
from cvthead.errors import InputError
from cvthead.files import write_errors, write_file
from cvthead.official.manifest import Manifest
from cvthead.official.pipeline import OfficialPipeline
from cvthead.points import PointLayout
from cvthead.runtime.threads import one_thread_per_call
from cvthead.tracking.tracker import FaceTurnedWarning, Tracker
from cvthead.training.records import index_of


@dataclass(frozen=True)
class Settings:
    """What a prepared folder depends on, beside its input.

    Attributes:
        val, test: shares of the identities.
        frames: sampled from each video.
        crop: see cvthead.data.tracking.make_record.
        shard_size: records per shard.
        official: Manifest.tables_fingerprint of the import whose networks make records of the
            preset official; set by :func:`prepare`.
    """

    val: float = VAL
    test: float = TEST
    frames: int = 30
    crop: CropStyle = "head"
    shard_size: int = 256
    official: str | None = None


def prepare(
    videos: Path, out: Path, settings: Settings, *, processes: int, model: Path | None = None
) -> Report:
    """Make or complete a folder of records; shows a progress bar on standard error.

    Args:
        videos: see cvthead.data.layout.
        out: new, or one of an earlier call with the same settings.
        processes: workers, one core each.
        model: folder of the import whose networks make records of the preset official; None makes
            those of the open one.

    Raises:
        AssetError: nothing was imported there, or a file of it is missing or altered.
        InputError: nothing to read, an output folder of other settings, no space, or a worker
            that the system has killed.
    """
    if model is not None:
        settings = replace(settings, official=Manifest.load(model).tables_fingerprint)
    items, others = find_items(videos, val=settings.val, test=settings.test)
    with write_errors(out):
        for name in (*SPLITS, "pending"):
            (out / name).mkdir(parents=True, exist_ok=True)
    done = resume(out, settings)
    left = [item for item in items if item.key not in done]
    pending = {split: waiting(out, split, items, done) for split in SPLITS}
    work = partial(_work, videos, out / "pending", settings, model)
    with (
        (out / "journal.jsonl").open("a") as journal,
        workers(processes) as pool,
        tqdm(total=len(items), initial=len(items) - len(left), unit="file") as bar,
    ):
        # In order, so that the same input always makes the same shards.
        for item, outcome in zip(left, pool.map(work, left), strict=True):
            done[item.key] = outcome
            print(json.dumps({"key": item.key} | asdict(outcome)), file=journal, flush=True)
            if outcome.dropped is None:
                pending[item.split].append(item)
            if len(pending[item.split]) == settings.shard_size:
                pack(out, item.split, pending[item.split], done, settings)
                pending[item.split] = []
            bar.update()
    for split, rest in pending.items():
        if rest:
            pack(out, split, rest, done, settings)
    (out / "pending").rmdir()
    report = Report.of(items, others, done)
    write_file(out / "report.json", json.dumps(asdict(report), indent=1).encode())
    return report


@contextmanager
def workers(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end with the block, whatever ends it.

    Raises:
        InputError: the system has killed a worker.
    """
    pool = ProcessPoolExecutor(processes, get_context("spawn"), _start_worker)
    try:
        yield pool
    except BrokenProcessPool as error:
        raise InputError(
            "a worker was killed, perhaps for want of memory",
            hint="call again with fewer --processes; what is finished is kept",
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def resume(out: Path, settings: Settings) -> dict[str, Outcome]:
    """What an earlier call finished, by key; starts the journal when there was none.

    Raises:
        InputError: the folder was made with other settings.
    """
    journal = out / "journal.jsonl"
    head = {"settings": asdict(settings)}
    if not journal.exists():
        write_file(journal, (json.dumps(head) + "\n").encode())
        return {}
    text = journal.read_text()
    # A kill can cut the last line short; its file is done again.
    lines = [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]
    # A setting that is newer than the journal had its default's effect.
    made = lines[0].get("settings") if lines else None
    if made is None or asdict(Settings()) | made != head["settings"]:
        raise InputError(
            f"{out} was made with other settings",
            hint="choose a new folder, or the settings in the first line of its journal.jsonl",
        )
    write_file(journal, "".join(json.dumps(line) + "\n" for line in lines).encode())
    return {line.pop("key"): Outcome(**line) for line in lines[1:]}


def waiting(out: Path, split: Split, items: list[Item], done: dict[str, Outcome]) -> list[Item]:
    """Finished items of a split that are in no shard yet; removes what a kill left over."""
    packed: set[str] = set()
    for shard in shards(out / split):
        packed.update(json.loads(index_of(shard).read_text()))
    left = []
    for item in items:
        if item.split == split and item.key in done and done[item.key].dropped is None:
            if item.key in packed:
                pending_file(out, item).unlink(missing_ok=True)
            else:
                left.append(item)
    return left


def shards(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.tar"))


def pending_file(out: Path, item: Item) -> Path:
    return out / "pending" / f"{item.key}.npz"


def pack(
    out: Path, split: Split, items: list[Item], done: dict[str, Outcome], settings: Settings
) -> None:
    """Move pending records into a new shard."""
    shard = out / split / f"{len(shards(out / split)):06d}.tar"
    write_shard(
        shard,
        {
            item.key: (pending_file(out, item), facts(item, done[item.key], settings))
            for item in items
        },
    )
    for item in items:
        pending_file(out, item).unlink()


def facts(item: Item, outcome: Outcome, settings: Settings) -> dict[str, Any]:
    """The JSON beside a record."""
    return {
        "file": item.file.as_posix(),
        "identity": item.identity,
        "split": item.split,
        "frames": outcome.frames,
        "crop": settings.crop,
    } | ({"official": settings.official} if settings.official else {})


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's affair
    one_thread_per_call()
    warnings.simplefilter("ignore", FaceTurnedWarning)

    def leave_with_parent() -> None:
        parent = parent_process()
        assert parent is not None
        parent.join()
        _exit(1)

    # A killed parent cannot end its workers, which would wait for work for ever.
    threading.Thread(target=leave_with_parent, daemon=True).start()


@cache
def _models() -> tuple[Tracker, DeformationModel, PointLayout]:
    tracker = Tracker.load()
    return tracker, DeformationModel.from_head(tracker.head), PointLayout.of(tracker.head)


@cache
def _official(model: Path) -> OfficialPipeline:
    return OfficialPipeline.load(model, threads=1)


def _work(
    videos: Path, pending: Path, settings: Settings, model: Path | None, item: Item
) -> Outcome:
    make = (
        partial(make_record, *_models())
        if model is None
        else partial(make_official_record, _official(model))
    )
    return make(
        videos / item.file,
        pending / f"{item.key}.npz",
        is_video=item.is_video,
        frames=settings.frames,
        crop=settings.crop,
    )
