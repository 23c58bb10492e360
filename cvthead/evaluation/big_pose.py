"""Source and driver of one clip whose heads are turned far apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvthead.evaluation.shots import Take, angle, rotation
from cvthead.tracking.tracker import TrackedFace

DEGREES = 30.0
# Frames of a clip that are looked at, sources and drivers per source that are rendered: all pairs
# of a clip that turns would be thousands.
LOOKED_AT, SOURCES, DRIVERS = 24, 4, 4


@dataclass(frozen=True)
class Pairs:
    """Frame numbers of one clip.

    Attributes:
        chosen: source -> drivers.
        found: ordered pairs more than DEGREES apart among the frames that were looked at.
    """

    chosen: dict[int, list[int]]
    found: int


def big_pose_pairs(take: Take, faces: Sequence[TrackedFace | None]) -> Pairs:
    """Evenly spread pairs of a clip whose heads are more than DEGREES apart.

    Args:
        faces: tracked in each frame of the clip.
    """
    step = max(1, len(take.frames) // LOOKED_AT)
    turns = {
        number: rotation(face.coefficients)
        for number, face in enumerate(faces)
        if number % step == 0 and face is not None
    }
    far = {
        source: [other for other in turns if angle(turn, turns[other]) > DEGREES]
        for source, turn in turns.items()
    }
    far = {source: others for source, others in far.items() if others}
    chosen = {source: spread(far[source], DRIVERS) for source in spread(list(far), SOURCES)}
    return Pairs(chosen, sum(map(len, far.values())))


def spread(numbers: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the numbers, evenly spaced, the first and the last among them."""
    places = np.linspace(0, len(numbers) - 1, min(count, len(numbers))).round().astype(int)
    return [numbers[place] for place in places]
