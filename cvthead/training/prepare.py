"""Track stills and clips once and store them as training records.

python -m cvthead.training.prepare ../shared/data/stills/train ../shared/data/clips/train OUT
"""

from __future__ import annotations

import argparse
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from multiprocessing import Pool
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cvthead.coefficients import Coefficients
from cvthead.deformation import DeformationModel
from cvthead.errors import CVTHeadError
from cvthead.points import PointLayout
from cvthead.source import HeadCrop, cut_head, read_source
from cvthead.tracking.tracker import FaceTurnedWarning, TrackedFace, Tracker
from cvthead.training import records

FRAMES_PER_CLIP = 30
SOURCES_PER_CLIP = 8
SHAPE_FRAMES = 8
MAX_ERROR = 3.0  # percent of the outer-eye distance
MIN_PERSON = 0.15  # share of the crop
VIDEO_SUFFIXES = {".mp4", ".mov", ".webm", ".avi", ".mkv", ".gif"}


@cache
def _worker() -> tuple[Tracker, DeformationModel, PointLayout]:
    cv2.setNumThreads(1)
    warnings.simplefilter("ignore", FaceTurnedWarning)
    tracker = Tracker.load()
    return tracker, DeformationModel.from_head(tracker.head), PointLayout.of(tracker.head)


def read_frames(path: Path) -> list[NDArray[np.uint8]]:
    """The still, or up to FRAMES_PER_CLIP evenly spaced frames of the clip, as RGB."""
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
        return [] if image is None else [image.astype(np.uint8)]
    frames = list(_video(path))
    wanted = np.unique(np.linspace(0, len(frames) - 1, FRAMES_PER_CLIP).astype(int))
    return [frames[i] for i in wanted]


def _video(path: Path) -> Iterator[NDArray[np.uint8]]:
    capture = cv2.VideoCapture(str(path))
    while True:
        found, frame = capture.read()
        if not found:
            return
        yield np.ascontiguousarray(frame[..., ::-1]).astype(np.uint8)


def track_identity(
    tracker: Tracker, frames: list[NDArray[np.uint8]]
) -> list[tuple[NDArray[np.uint8], TrackedFace]]:
    """Frames whose face is tracked well, all with the median shape of a few of them."""
    shape = None
    if len(frames) > 1:
        shapes = []
        for frame in frames[:: max(1, len(frames) // SHAPE_FRAMES)]:
            try:
                shapes.append(tracker.track(frame).coefficients.shape)
            except CVTHeadError:
                continue
        if not shapes:
            return []
        shape = np.median(shapes, axis=0).astype(np.float32)
    tracked = []
    for frame in frames:
        try:
            face = tracker.track(frame, shape=shape)
        except CVTHeadError:
            continue
        if face.error <= MAX_ERROR:
            tracked.append((frame, face))
    return tracked


def prepare(job: tuple[Path, Path]) -> str:
    """Track one file and store its record; returns the outcome for the report."""
    path, out = job
    if out.exists():
        return "already there"
    tracker, deformer, layout = _worker()
    heads: list[HeadCrop] = []
    for image, face in track_identity(tracker, read_frames(path)):
        try:
            head = cut_head(tracker, image, face)
        except CVTHeadError:
            continue
        if head.mask.mean() >= MIN_PERSON:
            heads.append(head)
    if not heads:
        return "dropped: no well tracked frame"
    shape = heads[0].coefficients.shape
    heads = [replace(h, coefficients=_with_shape(h.coefficients, shape)) for h in heads]
    chosen = np.unique(np.linspace(0, len(heads) - 1, SOURCES_PER_CLIP).astype(int))
    sources = {}
    for number in chosen.tolist():
        try:
            sources[number] = read_source(deformer, layout, heads[number])
        except CVTHeadError:
            continue
    if not sources:
        return "dropped: no usable source frame"
    records.write(out, heads, sources)
    return "stored"


def _with_shape(coefficients: Coefficients, shape: NDArray[np.float32]) -> Coefficients:
    return replace(coefficients, shape=shape)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("inputs", nargs="+", type=Path, help="folders of stills or clips")
    parser.add_argument("out", type=Path)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    files = sorted(p for folder in arguments.inputs for p in folder.iterdir() if p.is_file())
    jobs = [(path, arguments.out / f"{path.stem}.npz") for path in files]
    outcomes: Counter[str] = Counter()
    with Pool(arguments.processes) as pool:
        for outcome in tqdm(pool.imap_unordered(prepare, jobs), total=len(jobs)):
            outcomes[outcome] += 1
    for outcome, count in outcomes.most_common():
        print(f"{count:6d} {outcome}")


if __name__ == "__main__":
    main()
