"""Which videos are measured, and whom they show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cvthead.data.layout import TEST, VAL, Split, find_items
from cvthead.errors import InputError


@dataclass(frozen=True)
class Video:
    """A video to measure.

    Attributes:
        name: unlike that of any other, fit for a file name.
        identity: whose face it shows.
    """

    path: Path
    name: str
    identity: str


def find_videos(folder: Path, split: Split | None) -> list[Video]:
    """``clips/val/*.mp4`` of a folder, each a person of its own; of a folder without
    ``clips/val`` all videos, their people by cvthead.data.layout.

    Args:
        split: only the people whom ``cvthead data prepare`` puts into it by default; None for
            everybody.

    Raises:
        InputError: there are none, or a split of ``clips/val`` was asked for.
    """
    clips = folder / "clips" / "val"
    if clips.is_dir():
        if split:
            raise InputError(
                f"{clips} is held out as a whole and has no split {split}",
                hint="leave --split out, or pass a folder without clips/val",
            )
        videos = [Video(path, path.stem, path.stem) for path in sorted(clips.glob("*.mp4"))]
    else:
        items, _ = find_items(folder, val=VAL, test=TEST)
        videos = [
            Video(folder / item.file, item.key, item.identity)
            for item in items
            if item.is_video and split in (None, item.split)
        ]
    if not videos:
        of_split = f" of the split {split}" if split else ""
        raise InputError(
            f"no video{of_split} in {folder}", hint="pass a folder of videos, or with clips/val"
        )
    return videos
