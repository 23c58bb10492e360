"""The clips that a measuring tool goes through: its arguments, and each source with its drivers."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from cvthead.evaluation.shots import Shot, read_take
from cvthead.evaluation.videos import find_videos
from cvthead.tracking.tracker import Tracker


def clip_arguments(prog: str, description: str | None, *, drivers: int) -> argparse.ArgumentParser:
    """A parser of ``data``, ``--every`` and ``--drivers``."""
    parser = argparse.ArgumentParser(prog=prog, description=description)
    parser.add_argument("data", type=Path, help="as `cvthead evaluate --data`")
    parser.add_argument("--every", type=int, default=1, help="take every n-th clip")
    parser.add_argument("--drivers", type=int, default=drivers, help="driving frames per clip")
    return parser


def clips(tracker: Tracker, args: argparse.Namespace) -> Iterator[tuple[Shot, list[Shot]]]:
    """The source of each clip that shows a face, and its driving frames that do."""
    for video in find_videos(args.data, None)[:: args.every]:
        take = read_take(tracker, video.path, video.name)
        if take is not None:
            drivers = (take.driver(tracker, number) for number in take.spread(args.drivers))
            yield take.source, [driver for driver in drivers if driver is not None]
