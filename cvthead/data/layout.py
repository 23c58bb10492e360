"""Which files there are, whose they are, and on which side of the split they fall.

Identities come from the path: VoxCeleb2 (``dev/mp4/id00012/21Uxsk56VDQ/00001.mp4``), VoxCeleb1
(``id10001/1zcIwhmdeo4/00001.mp4``), FOMM's form of it (``id10001#1zcIwhmdeo4#000878#001012.mp4``),
one folder per person, or plain files, each a person of its own.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Literal

from cvthead.errors import InputError

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".webm", ".avi", ".mkv", ".gif"})
STILL_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp"})
# Default shares of the identities.
VAL, TEST = 0.05, 0.05
# Folders that VoxCeleb's archives put above the identities.
WRAPPERS = frozenset({"dev", "test", "mp4"})
VOXCELEB = re.compile(r"id\d{5}")


@dataclass(frozen=True)
class Item:
    """A video or a still of the input folder.

    Attributes:
        file: relative to the input folder.
        key: unique name of its record.
        identity: whose face it shows; an identity lies in one split only.
        split: "train", "val" or "test".
    """

    file: PurePath
    key: str
    identity: str
    split: Split

    @property
    def is_video(self) -> bool:
        return self.file.suffix.lower() in VIDEO_SUFFIXES


def find_items(folder: Path, *, val: float, test: float) -> tuple[list[Item], list[PurePath]]:
    """All videos and stills below a folder, sorted, and the files that are neither.

    Args:
        folder: searched with its sub-folders; hidden files are passed over.
        val, test: shares of the identities, 0..1.

    Raises:
        InputError: no such folder, no video or still in it, or shares beyond 1.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder", hint="name the folder of the videos")
    if min(val, test) < 0 or val + test > 1:
        raise InputError(
            f"shares of {val} and {test} for validation and test do not fit into 1",
            hint="give two shares from 0 to 1",
        )
    files = sorted(
        path.relative_to(folder)
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith(".")
    )
    items, others = [], []
    for file in files:
        if file.suffix.lower() in VIDEO_SUFFIXES | STILL_SUFFIXES:
            identity = identity_of(file)
            split = split_of(identity, val=val, test=test)
            items.append(Item(file, key_of(file), identity, split))
        else:
            others.append(PurePath(file))
    if not items:
        raise InputError(f"no video or still in {folder}", hint="name the folder of the videos")
    return items, others


def identity_of(file: PurePath) -> str:
    """The person, by the path relative to the input folder."""
    for name in file.parts:
        if found := VOXCELEB.match(name):
            return found[0]
    folders = [name for name in file.parts[:-1] if name not in WRAPPERS]
    return folders[0] if folders else file.stem


def key_of(file: PurePath) -> str:
    """The stem, made unique by the path and free of the characters that tar shards give a
    meaning: VoxCeleb has a 00001.mp4 in every folder."""
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", file.stem)
    return f"{stem}-{hashlib.sha256(file.as_posix().encode()).hexdigest()[:8]}"


def split_of(identity: str, *, val: float, test: float) -> Split:
    """By hash, so that it stays the same when data is added later."""
    digest = hashlib.sha256(identity.encode()).digest()
    place = int.from_bytes(digest[:8]) / 2**64
    if place < val:
        return "val"
    return "test" if place < val + test else "train"
