"""Do results tremble? Change between consecutive frames inside the face, against the driver's.

Measured on the stillest stretch of a clip, in one fixed crop, twice. *Jitter on video*: each
frame is driven as tracked. *Flicker on still coefficients*: the coefficients are constant but for
the tracker's noise, which is what the tracked series leaves after its mean over three frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS, Camera, Crop
from cvthead.coefficients import Coefficients
from cvthead.evaluation.methods import Person
from cvthead.evaluation.shots import Image, Shot, Take, track
from cvthead.evaluation.table import Table
from cvthead.source import cut_head
from cvthead.tracking.tracker import TrackedFace, Tracker

Face = tuple[Coefficients, Camera]

STRETCH = 13  # frames; half a second
COLUMNS = {
    "jitter on video": ".4f",
    "flicker on still coefficients": ".4f",
    "jitter / driver": ".2f",
    "flicker / driver": ".2f",
    "clips with flicker below the driver": ".0%",
}


@dataclass(frozen=True)
class Steadiness:
    """Mean absolute change between consecutive frames inside the face, 0..1.

    Attributes:
        driver: of the driving video itself.
        jitter: by method, driven as tracked.
        flicker: by method, on constant coefficients with the tracker's noise.
    """

    driver: float
    jitter: Mapping[str, float]
    flicker: Mapping[str, float]


def follow_all(tracker: Tracker, take: Take) -> list[TrackedFace | None]:
    """Every frame of a clip tracked from the frame before, as a video is."""
    faces: list[TrackedFace | None] = []
    for frame in take.frames:
        previous = faces[-1] if faces else None
        faces.append(track(tracker, frame, shape=take.shape, previous=previous))
    return faces


def stillest(faces: Sequence[TrackedFace | None], length: int = STRETCH) -> int | None:
    """Start of the ``length`` consecutive frames whose landmarks move least; None if there are
    not so many in a row."""
    motion: dict[int, float] = {}
    for start in range(len(faces) - length + 1):
        stretch = [face for face in faces[start : start + length] if face is not None]
        if len(stretch) == length:
            points = np.stack([face.landmarks[:, :2] / face.camera.scale for face in stretch])
            motion[start] = float(np.linalg.norm(np.diff(points, axis=0), axis=2).mean())
    return min(motion, key=lambda start: motion[start]) if motion else None


def steadiness(
    tracker: Tracker,
    take: Take,
    faces: Sequence[TrackedFace | None],
    persons: Mapping[str, Person],
) -> Steadiness | None:
    """Measure one clip; None if it has no stretch in which every frame is tracked."""
    start = stillest(faces)
    if start is None:
        return None
    numbers = range(start, start + STRETCH)
    shots = [
        Shot(take.name, n, take.frames[n], face, cut_head(tracker, take.frames[n], face))
        for n in numbers
        if (face := faces[n]) is not None
    ]
    crop = shots[0].head.crop
    inside = face_pixels(shots[0].face, crop) & shots[0].head.valid
    jitter, flicker = {}, {}
    for name, person in persons.items():
        asked = [person.asked(shot, crop) for shot in shots]
        jitter[name] = change([person.draw(*one).on_white for one in asked], inside)
        flicker[name] = change([person.draw(*one).on_white for one in still(asked)], inside)
    video = [crop.cut(shot.image)[0] for shot in shots]
    return Steadiness(change(video, inside), jitter, flicker)


def change(pictures: Sequence[Image], inside: NDArray[np.bool_]) -> float:
    """Mean absolute difference of consecutive (S, S, 3) pictures where ``inside``, 0..1."""
    values = np.stack([picture[inside] for picture in pictures]).astype(np.float32)
    return float(np.abs(np.diff(values, axis=0)).mean() / 255)


def face_pixels(face: TrackedFace, crop: Crop) -> NDArray[np.bool_]:
    """(256, 256) pixels of the crop within the hull of the landmarks."""
    points = (face.landmarks[:, :2] - (crop.left, crop.top)) * (CROP_PIXELS / crop.size)
    hull = cv2.convexHull(np.round(points).astype(np.int32))
    filled = cv2.fillConvexPoly(np.zeros((CROP_PIXELS,) * 2, np.uint8), hull, 1)
    return filled.astype(bool)


def still(series: Sequence[Face]) -> list[Face]:
    """Constant coefficients and camera with the noise of a tracked series: its mean, plus what
    each frame has beyond the mean of itself and its two neighbours.

    Args:
        series: three or more.

    Returns:
        Two fewer.
    """
    vectors = np.stack([vector(one) for one in series])
    smooth = (vectors[:-2] + vectors[1:-1] + vectors[2:]) / 3
    # White noise keeps two thirds of its variance when its mean over three frames is taken off.
    noise = (vectors[1:-1] - smooth) * np.sqrt(1.5)
    shape = series[0][0].shape
    return [face_of(shape, one) for one in vectors.mean(axis=0) + noise]


def vector(face: Face) -> NDArray[np.float64]:
    """Expression (50), pose (15), scale, tx and ty."""
    coefficients, camera = face
    parts = coefficients.expression, coefficients.pose, (camera.scale, camera.tx, camera.ty)
    return np.concatenate(parts).astype(np.float64)


def face_of(shape: NDArray[np.float32], values: NDArray[np.float64]) -> Face:
    expression, pose, camera = np.split(values.astype(np.float32), (50, 65))
    return Coefficients(shape, expression, pose), Camera(*camera.tolist())


def steadiness_table(done: Sequence[Steadiness]) -> Table:
    """Means of the clips, and medians of their ratios to the driving video."""
    driver = np.array([one.driver for one in done])
    rows: dict[str, tuple[float, ...]] = {}
    for name in done[0].jitter:
        jitter = np.array([one.jitter[name] for one in done])
        flicker = np.array([one.flicker[name] for one in done])
        rows[name] = (
            float(jitter.mean()),
            float(flicker.mean()),
            float(np.median(jitter / driver)),
            float(np.median(flicker / driver)),
            float((flicker <= driver).mean()),
        )
    nothing = float("nan")
    rows["driving video"] = (float(driver.mean()), nothing, 1.0, nothing, nothing)
    caption = (
        f"Steadiness: mean absolute change between consecutive frames inside the face, on the "
        f"stillest {STRETCH} frames of {len(done)} clips; ratios are medians."
    )
    return Table("steadiness", caption, COLUMNS, rows)
