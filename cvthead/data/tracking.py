"""One video or still -> its training record, or the reason why it has none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Crop
from cvthead.crop import head_crop
from cvthead.deformation import DeformationModel
from cvthead.errors import CVTHeadError
from cvthead.images import read_image
from cvthead.points import PointLayout
from cvthead.source import HeadCrop, cut_head, read_source
from cvthead.tracking.tracker import TrackedFace, Tracker
from cvthead.training import records
from cvthead.video import read_frames

Image = NDArray[np.uint8]
CropStyle = Literal["head", "clip"]

SOURCES_PER_CLIP = 8
SHAPE_FRAMES = 8
MAX_ERROR = 3.0  # percent of the outer-eye distance
MIN_PERSON = 0.15  # share of the crop
MIN_FRAMES = 5  # of a clip, well tracked

UNREADABLE, TOO_SHORT, LOST = "unreadable", "too short", "lost"
BADLY_FITTED, NO_PERSON, NO_SOURCE = "badly fitted", "no person", "no usable source frame"


@dataclass(frozen=True)
class Outcome:
    """What became of a file.

    Attributes:
        frames: stored frames; 0 when the file was dropped.
        dropped: why, or None.
        frames_dropped: how many sampled frames were left out, by reason.
    """

    frames: int = 0
    dropped: str | None = None
    frames_dropped: Mapping[str, int] = field(default_factory=dict)


def sampled_frames(path: Path, count: int) -> list[Image]:
    """Up to ``count`` evenly spaced frames; the video is decoded twice, never held whole.

    Raises:
        VideoError: not a readable video.
    """
    length = sum(1 for _ in read_frames(path))
    wanted = set(np.linspace(0, length - 1, count).astype(int).tolist())
    return [frame.rgb for number, frame in enumerate(read_frames(path)) if number in wanted]


def track_frames(
    tracker: Tracker, frames: Sequence[Image]
) -> tuple[list[tuple[Image, TrackedFace]], Counter[str]]:
    """Frames whose face is tracked well, all with the median shape of a few of them, and how
    many frames were left out by reason."""
    dropped: Counter[str] = Counter()
    shape = None
    if len(frames) > 1:
        shapes = []
        for frame in frames[:: max(1, len(frames) // SHAPE_FRAMES)]:
            try:
                shapes.append(tracker.track(frame).coefficients.shape)
            except CVTHeadError as error:
                dropped[reason(error)] += 1
        if not shapes:
            return [], dropped
        shape = np.median(shapes, axis=0).astype(np.float32)
        dropped.clear()  # the same frames are counted below
    tracked = []
    for frame in frames:
        try:
            face = tracker.track(frame, shape=shape)
        except CVTHeadError as error:
            dropped[reason(error)] += 1
            continue
        if face.error <= MAX_ERROR:
            tracked.append((frame, face))
        else:
            dropped[BADLY_FITTED] += 1
    return tracked, dropped


def reason(error: CVTHeadError) -> str:
    """``no face``, ``face too small``, ``face turned away``."""
    return error.code.replace("_", " ")


def clip_crop(tracker: Tracker, faces: Sequence[TrackedFace]) -> Crop:
    """One square that holds the head crops of all frames of a clip, as FOMM cuts its data:
    the head moves inside of it."""
    crops = [head_crop(tracker.head, face.coefficients, face.camera) for face in faces]
    corners = np.array([[c.left, c.top, c.left + c.size, c.top + c.size] for c in crops])
    left, top = corners[:, :2].min(0)
    right, bottom = corners[:, 2:].max(0)
    size = max(right - left, bottom - top)
    return Crop(float((left + right - size) / 2), float((top + bottom - size) / 2), float(size))


@dataclass(frozen=True)
class TrackedFile:
    """What of a file is tracked well.

    Attributes:
        faces: frames and their faces, one or more.
        square: that all frames are cut to; None cuts each to its own head.
        dropped: frames left out, by reason; those who go on count theirs in it.
    """

    faces: Sequence[tuple[Image, TrackedFace]]
    square: Crop | None
    dropped: Counter[str]

    def too_few(self, kept: int, *, is_video: bool) -> Outcome | None:
        """What becomes of the file if only so many frames could be cut; None: it goes on."""
        if kept >= (MIN_FRAMES if is_video else 1):
            return None
        return Outcome(dropped=LOST if kept else NO_PERSON, frames_dropped=dict(self.dropped))


def read_tracked(
    tracker: Tracker, path: Path, *, is_video: bool, frames: int, crop: CropStyle
) -> TrackedFile | Outcome:
    """Track a file, or say why it is of no use; arguments as :func:`make_record`."""
    try:
        images = sampled_frames(path, frames) if is_video else [read_image(path)]
    except CVTHeadError:
        return Outcome(dropped=UNREADABLE)
    if is_video and len(images) < MIN_FRAMES:
        return Outcome(dropped=TOO_SHORT)
    tracked, dropped = track_frames(tracker, images)
    if not tracked:
        return Outcome(dropped=dropped.most_common(1)[0][0], frames_dropped=dict(dropped))
    square = clip_crop(tracker, [face for _, face in tracked]) if crop == "clip" else None
    return TrackedFile(tracked, square, dropped)


def make_record(
    tracker: Tracker,
    deformer: DeformationModel,
    layout: PointLayout,
    path: Path,
    out: Path,
    *,
    is_video: bool,
    frames: int,
    crop: CropStyle,
) -> Outcome:
    """Track a file and store its record.

    Args:
        tracker, deformer, layout: of one head model.
        path: video or still.
        out: the .npz file; not written when the file is dropped.
        frames: sampled from a video.
        crop: "head", the default, is the crop that the renderer's network sees when it serves: a
            square of 0.36 m fixed to the face of each frame, so that training and use agree.
            "clip" is FOMM's and the paper's: one square per clip, within which the head moves.
    """
    found = read_tracked(tracker, path, is_video=is_video, frames=frames, crop=crop)
    if isinstance(found, Outcome):
        return found
    dropped = found.dropped
    heads = []
    for head in _cut(tracker, found.faces, found.square):
        if head is not None and head.mask.mean() >= MIN_PERSON:
            heads.append(head)
        else:
            dropped[NO_PERSON] += 1
    if outcome := found.too_few(len(heads), is_video=is_video):
        return outcome
    sources = {}
    chosen = np.unique(np.linspace(0, len(heads) - 1, SOURCES_PER_CLIP).astype(int))
    for number in chosen.tolist():
        try:
            sources[number] = read_source(deformer, layout, heads[number])
        except CVTHeadError:
            continue
    if not sources:
        return Outcome(dropped=NO_SOURCE, frames_dropped=dict(dropped))
    records.write(out, heads, sources)
    return Outcome(len(heads), frames_dropped=dict(dropped))


def _cut(
    tracker: Tracker, tracked: Sequence[tuple[Image, TrackedFace]], square: Crop | None
) -> Iterator[HeadCrop | None]:
    """Head crops with one shape for all; None where that fails."""
    shape = tracked[0][1].coefficients.shape
    for image, face in tracked:
        try:
            head = cut_head(tracker, image, face, square)
        except CVTHeadError:
            yield None
            continue
        yield replace(head, coefficients=replace(head.coefficients, shape=shape))
