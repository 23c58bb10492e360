"""One video -> its training record for the official preset, or the reason why it has none."""

from __future__ import annotations

from pathlib import Path

from cvthead.data.tracking import (
    LOST,
    MIN_FRAMES,
    MIN_PERSON,
    NO_PERSON,
    CropStyle,
    Outcome,
    clip_crop,
    read_tracked,
)
from cvthead.official.networks import picture_array
from cvthead.official.pipeline import OfficialPipeline
from cvthead.training import official_records
from cvthead.training.official_records import OfficialFrame

STILL = "a still"


def make_official_record(
    pipeline: OfficialPipeline,
    path: Path,
    out: Path,
    *,
    is_video: bool,
    frames: int,
    crop: CropStyle,
) -> Outcome:
    """Let the imported networks say of every frame what encoding a portrait asks them.

    Args:
        pipeline: of the import; its network itself does not run.
        path: video. A still is left out: the paper learns from two frames of one video.
        out: the .npz file; not written when the file is dropped.
        frames: sampled from a video.
        crop: as :func:`cvthead.data.tracking.make_record`; "clip" is what the paper had.
    """
    if not is_video:
        return Outcome(dropped=STILL)
    tracker = pipeline.tracker
    found = read_tracked(tracker.finder, path, is_video=True, frames=frames)
    if isinstance(found, Outcome):
        return found
    tracked, dropped = found
    one = clip_crop(tracker.finder, [face for _, face in tracked]) if crop == "clip" else None
    kept = []
    for image, face in tracked:
        picture = tracker.cut(image, face, one)
        _, valid = picture.crop.cut(image)
        array = picture_array(picture.pixels)
        mask = pipeline.mask(array)[0, 0]
        if mask.mean() < MIN_PERSON:
            dropped[NO_PERSON] += 1
            continue
        square = picture.square
        estimate = tracker.estimate(picture.pixels, square)
        kept.append(
            OfficialFrame(
                picture.pixels,
                mask,
                valid,
                estimate.coefficients,
                square.camera(estimate.cam),
                square,
                pipeline.hair(array),
            )
        )
    if len(kept) < MIN_FRAMES:
        return Outcome(dropped=LOST if kept else NO_PERSON, frames_dropped=dict(dropped))
    official_records.write(out, kept, pipeline.networks.manifest.tables)
    return Outcome(len(kept), frames_dropped=dict(dropped))
