"""How well the tracker does: ``python -m cvthead.evaluation.tracking [data directory]``.

Prints the error on photographs (overall and by yaw), the time of a driving frame on one thread
and the share of lost video frames. Data: ``stills/val`` and ``clips/val`` below the directory.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.errors import FaceError
from cvthead.runtime.threads import one_thread_per_call
from cvthead.tracking.tracker import FaceTurnedWarning, TrackedFace, Tracker

YAW_BINS = ((0.0, 15.0), (15.0, 30.0), (30.0, 90.0))
TARGET_ERROR, TARGET_MILLISECONDS, TARGET_LOST = 1.3, 12.0, 0.005


def read_image(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) RGB."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise FileNotFoundError(path)
    return image.astype(np.uint8, copy=False)


def read_frames(path: Path, limit: int | None) -> Iterator[NDArray[np.uint8]]:
    """The first ``limit`` frames of a clip, (H, W, 3) RGB."""
    capture = cv2.VideoCapture(str(path))
    count = 0
    while limit is None or count < limit:
        found, frame = capture.read()
        if not found:
            break
        count += 1
        yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    capture.release()


@dataclass(frozen=True)
class ClipResult:
    """Frames of one clip, those without a face found, median error (%) and the times (ms)."""

    name: str
    frames: int
    lost: int
    error: float
    milliseconds: tuple[float, ...]


def track_clip(tracker: Tracker, path: Path, limit: int | None = None) -> ClipResult:
    """Track a clip with the identity of its first tracked frame."""
    previous: TrackedFace | None = None
    shape = None
    frames = lost = 0
    errors: list[float] = []
    times: list[float] = []
    for frame in read_frames(path, limit):
        frames += 1
        followed = previous is not None
        start = time.perf_counter()
        try:
            previous = tracker.track(frame, shape=shape, previous=previous)
        except FaceError:
            lost, previous = lost + 1, None
            continue
        if followed:
            times.append((time.perf_counter() - start) * 1e3)
        shape = previous.coefficients.shape if shape is None else shape
        errors.append(previous.error)
    error = float(np.median(errors)) if errors else float("nan")
    return ClipResult(path.name, frames, lost, error, tuple(times))


def still_lines(tracker: Tracker, paths: Sequence[Path]) -> list[str]:
    """Table of the error on photographs."""
    found: list[TrackedFace] = []
    lines = []
    for path in paths:
        try:
            found.append(tracker.track(read_image(path)))
        except FaceError as error:
            lines.append(f"stills: {path.name}: {error}")
    errors = np.array([face.error for face in found])
    yaws = np.abs([face.yaw for face in found])
    lines.append(
        f"stills: {len(found)} of {len(paths)} tracked; error, % of the outer-eye distance:"
        f" median {np.median(errors):.2f} (target {TARGET_ERROR}),"
        f" p90 {np.percentile(errors, 90):.2f}"
    )
    for low, high in YAW_BINS:
        chosen = errors[(yaws >= low) & (yaws < high)]
        if chosen.size:
            lines.append(
                f"  yaw {low:.0f}-{high:.0f} degrees: median {np.median(chosen):.2f}"
                f" ({chosen.size} images)"
            )
    return lines


def clip_lines(tracker: Tracker, paths: Sequence[Path], limit: int | None) -> list[str]:
    """Table of lost frames and times."""
    results = [track_clip(tracker, path, limit) for path in paths]
    frames, lost = sum(r.frames for r in results), sum(r.lost for r in results)
    times = np.concatenate([np.array(r.milliseconds) for r in results])
    lines = [
        f"  {r.name}: {r.lost} of {r.frames} frames lost, median error {r.error:.2f}"
        for r in results
        if r.lost
    ]
    return [
        f"clips: {lost} of {frames} frames lost = {lost / frames:.2%} (target {TARGET_LOST:.1%});"
        f" median error {np.nanmedian([r.error for r in results]):.2f}",
        *lines,
        f"driving frame: median {np.median(times):.1f} ms, p95 {np.percentile(times, 95):.1f} ms"
        f" (target {TARGET_MILLISECONDS:.0f}, one thread)",
    ]


def main() -> None:
    one_thread_per_call()
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(__file__).resolve().parents[2].parent / "shared" / "data"
    parser.add_argument("data", nargs="?", type=Path, default=default)
    parser.add_argument("--limit", type=int, help="at most so many stills, and frames per clip")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    warnings.simplefilter("ignore", FaceTurnedWarning)
    tracker = Tracker.load()
    stills = sorted((arguments.data / "stills" / "val").glob("*.jpg"))
    # Every set of photographs should be in a limited run.
    step = max(1, len(stills) // arguments.limit) if arguments.limit else 1
    for line in still_lines(tracker, stills[::step]):
        print(line, flush=True)
    clips = sorted((arguments.data / "clips" / "val").glob("*.mp4"))
    for line in clip_lines(tracker, clips, arguments.limit):
        print(line, flush=True)


if __name__ == "__main__":
    main()
