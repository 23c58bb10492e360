"""Does the result move as the driver does? Motion is tracked again in the rendered pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from cvthead.evaluation.table import Table
from cvthead.tracking.networks import BLENDSHAPE_NAMES, Networks
from cvthead.tracking.tracker import TrackedFace

UNITS = {"yaw": "degrees", "jaw": "degrees", "smile": "score 0..1", "gaze": "degrees"}
COLUMNS = {
    "r over all frames": ".3f",
    "r within clips": ".3f",
    "mean error": ".3g",
    "driver's spread": ".3g",
}


@dataclass(frozen=True)
class Motion:
    """What one face does.

    Attributes:
        yaw: degrees, positive to the subject's left.
        jaw: opening in degrees.
        smile: mean of the blendshape scores mouthSmileLeft and mouthSmileRight, 0..1.
        gaze: horizontal, degrees within the head, positive to the subject's left.
    """

    yaw: float
    jaw: float
    smile: float
    gaze: float


@dataclass(frozen=True)
class Agreement:
    """How one motion of the results follows the drivers'.

    Attributes:
        pooled: Pearson correlation over all frames.
        within: Pearson correlation after each clip's mean is taken off; unlike ``pooled`` it
            cannot come from the people being different. NaN if nothing varies.
        error: mean absolute difference, in the motion's unit.
        spread: standard deviation of the drivers within their clips, in the motion's unit.
        frames: number of pairs.
    """

    pooled: float
    within: float
    error: float
    spread: float
    frames: int


def motion_of(face: TrackedFace, networks: Networks) -> Motion:
    scores = dict(zip(BLENDSHAPE_NAMES, networks.blendshapes(face.landmarks), strict=True))
    return Motion(
        yaw=face.yaw,
        jaw=float(np.degrees(face.coefficients.joint("jaw")[0])),
        smile=float(scores["mouthSmileLeft"] + scores["mouthSmileRight"]) / 2,
        gaze=float(np.degrees(face.coefficients.joint("left_eye")[1])),
    )


def agreements(clips: Sequence[Sequence[tuple[Motion, Motion]]]) -> dict[str, Agreement]:
    """Compare (driver, result) pairs, clip by clip, for each of the motions."""
    pairs = [np.array([[astuple(a), astuple(b)] for a, b in clip]) for clip in clips if clip]
    if not pairs:
        return {}
    values = np.concatenate(pairs)
    centred = np.concatenate([clip - clip.mean(0) for clip in pairs])
    return {
        field.name: Agreement(
            pooled=correlation(values[:, 0, i], values[:, 1, i]),
            within=correlation(centred[:, 0, i], centred[:, 1, i]),
            error=float(np.abs(values[:, 0, i] - values[:, 1, i]).mean()),
            spread=float(centred[:, 0, i].std()),
            frames=len(values),
        )
        for i, field in enumerate(fields(Motion))
    }


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Pearson's r; NaN if one of the two is constant."""
    a, b = a - a.mean(), b - b.mean()
    length = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / length if length > 1e-9 else float("nan")


def motion_table(name: str, clips: Sequence[Sequence[tuple[Motion, Motion | None]]]) -> Table:
    """Agreement of one method's results with their drivers; None is a result without a face."""
    kept = [[(wanted, got) for wanted, got in clip if got is not None] for clip in clips]
    frames = sum(map(len, clips))
    lost = frames - sum(map(len, kept))
    rows = {
        f"{motion}, {UNITS[motion]}": (one.pooled, one.within, one.error, one.spread)
        for motion, one in agreements(kept).items()
    }
    caption = f"Driver against the re-tracked result of {name} ({lost} of {frames} lost):"
    return Table(f"motion, {name}", caption, COLUMNS, rows, "motion")
