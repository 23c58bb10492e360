"""Does a result show what was asked for? Its face is tracked again and compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from cvthead.camera import CROP_PIXELS
from cvthead.coefficients import Array, Coefficients
from cvthead.deformation import to_pixels
from cvthead.evaluation.methods import Drawn
from cvthead.evaluation.shots import Shot, angle, rotation, track
from cvthead.tracking.tracker import TrackedFace, Tracker


@dataclass(frozen=True)
class Errors:
    """Distance of a result from what was asked.

    Attributes:
        pose: degrees between the asked and the tracked turn of the head.
        jaw: degrees of opening.
        landmarks: mean distance of the 478 landmarks from where the asked coefficients put them,
            in percent of the mean head's outer-eye distance.
        expression: mean difference of the 52 blendshape scores from the driver's, 0..1.
    """

    pose: float
    jaw: float
    landmarks: float
    expression: float


def retrack(tracker: Tracker, drawn: Drawn, shape: Array) -> TrackedFace | None:
    """The face in a result on white, tracked with the source's shape."""
    return track(tracker, drawn.on_white, shape=shape)


def errors(tracker: Tracker, shape: Array, driver: Shot, got: TrackedFace) -> Errors:
    """Compare a result with its driver.

    Args:
        shape: (100,) the source's identity.
        driver: whose expression and pose were asked for, in its own head crop.
        got: the face tracked in the 256 x 256 result.
    """
    asked = replace(driver.face.coefficients, shape=shape)
    networks = tracker.networks
    expression = networks.blendshapes(got.landmarks) - networks.blendshapes(driver.face.landmarks)
    distance = np.linalg.norm(
        landmark_pixels(tracker, asked, driver) - got.landmarks[:, :2], axis=1
    )
    unit = tracker.solver.basis.eye_distance * driver.head.camera.scale * CROP_PIXELS / 2
    return Errors(
        pose=angle(rotation(asked), rotation(got.coefficients)),
        jaw=abs(jaw_degrees(asked) - jaw_degrees(got.coefficients)),
        landmarks=float(distance.mean() / unit * 100),
        expression=float(np.abs(expression).mean()),
    )


def jaw_degrees(coefficients: Coefficients) -> float:
    return float(np.degrees(coefficients.joint("jaw")[0]))


def landmark_pixels(tracker: Tracker, asked: Coefficients, driver: Shot) -> Array:
    """(478, 2) the head model's landmarks in pixels of the driver's head crop."""
    head = tracker.head
    corners = head.vertices(asked)[head.faces[head.landmark_faces]]
    landmarks = np.einsum("nk,nkc->nc", head.landmark_bary, corners)
    return np.asarray(to_pixels(driver.head.camera.project(landmarks))[:, :2], np.float32)


def medians(found: Sequence[Errors]) -> Errors:
    """Median of each error; NaN of none."""
    if not found:
        return Errors(*([float("nan")] * len(fields(Errors))))
    return Errors(*(float(np.median([getattr(e, f.name) for e in found])) for f in fields(Errors)))
