"""Video frames and stills with the face tracked in them: sources and drivers of every measure."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.coefficients import Array, Coefficients
from cvthead.errors import FaceError
from cvthead.source import HeadCrop, cut_head
from cvthead.tracking.tracker import FaceTurnedWarning, TrackedFace, Tracker
from cvthead.video import read_frames

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture of a person.

    Attributes:
        name: of the clip or still.
        number: of the frame, 0 for a still.
        image: (H, W, 3) uint8 RGB, the whole picture.
        face: tracked in it.
        head: the head cut out of it.
    """

    name: str
    number: int
    image: Image
    face: TrackedFace
    head: HeadCrop


@dataclass(frozen=True, eq=False)
class Take:
    """A clip read into memory.

    Attributes:
        name: of its own among the clips that are measured.
        frames: all of them.
        source: the first frame in which a face can be tracked.
    """

    name: str
    frames: Sequence[Image]
    source: Shot

    @property
    def shape(self) -> Array:
        """(100,) identity that the source frame shows."""
        return self.source.face.coefficients.shape

    def driver(self, tracker: Tracker, number: int) -> Shot | None:
        """A frame tracked with the source's shape."""
        return shoot(tracker, self.name, number, self.frames[number], shape=self.shape)

    def spread(self, count: int) -> list[int]:
        """Numbers of evenly spaced frames after the source, up to the last one."""
        last = len(self.frames) - 1
        numbers = np.linspace(self.source.number, last, count + 1).round().astype(int)
        return [int(number) for number in np.unique(numbers)[1:]]


def read_take(tracker: Tracker, path: Path, name: str) -> Take | None:
    """Read a clip; None if no face can be tracked in it.

    Raises:
        VideoError: the file cannot be read.
    """
    frames = [frame.rgb for frame in read_frames(path)]
    for number, frame in enumerate(frames):
        source = shoot(tracker, name, number, frame)
        if source is not None:
            return Take(name, frames, source)
    return None


def shoot(
    tracker: Tracker, name: str, number: int, image: Image, *, shape: Array | None = None
) -> Shot | None:
    """Track the largest face, with a known shape if given; None if there is none."""
    face = track(tracker, image, shape=shape)
    if face is None:
        return None
    try:
        return Shot(name, number, image, face, cut_head(tracker, image, face))
    except FaceError:  # no person was segmented where the face is
        return None


def track(
    tracker: Tracker,
    image: Image,
    *,
    shape: Array | None = None,
    previous: TrackedFace | None = None,
) -> TrackedFace | None:
    """As Tracker.track, None instead of an error, and silent about turned heads."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FaceTurnedWarning)
        try:
            return tracker.track(image, shape=shape, previous=previous)
        except FaceError:
            return None


def rotation(coefficients: Coefficients) -> NDArray[np.float64]:
    """(3, 3) turn of the skull: global rotation and neck."""
    turns = [
        cv2.Rodrigues(coefficients.joint(name).astype(np.float64))[0] for name in ("global", "neck")
    ]
    return np.asarray(turns[0] @ turns[1], np.float64)


def angle(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Degrees between two rotations (3, 3), 0..180."""
    turn = cv2.Rodrigues(first.T @ second)[0]
    return float(np.degrees(np.linalg.norm(turn)))
