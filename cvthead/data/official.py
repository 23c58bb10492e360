"""One video -> its training record for the official preset, or the reason why it has none."""

from __future__ import annotations

from pathlib import Path

from cvthead.data.tracking import MIN_PERSON, NO_PERSON, CropStyle, Outcome, read_tracked
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
    found = read_tracked(tracker.finder, path, is_video=True, frames=frames, crop=crop)
    if isinstance(found, Outcome):
        return found
    kept = []
    for image, face in found.faces:
        picture = tracker.cut(image, face, found.square)
        array = picture_array(picture.pixels)
        mask = pipeline.mask(array)[0, 0]
        if mask.mean() < MIN_PERSON:
            found.dropped[NO_PERSON] += 1
            continue
        square = picture.square
        estimate = tracker.estimate(picture.pixels, square)
        kept.append(
            OfficialFrame(
                picture.pixels,
                mask,
                picture.crop.inside(image.shape[0], image.shape[1]),
                estimate.coefficients,
                square.camera(estimate.cam),
                square,
                pipeline.hair(array),
            )
        )
    if outcome := found.too_few(len(kept), is_video=True):
        return outcome
    official_records.write(out, kept, pipeline.networks.manifest.tables_fingerprint)
    return Outcome(len(kept), frames_dropped=dict(found.dropped))
