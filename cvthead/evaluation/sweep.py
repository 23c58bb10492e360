"""One person under a fixed series of poses and expressions, to look at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.crop import head_crop
from cvthead.evaluation.methods import Draw
from cvthead.evaluation.shots import Image
from cvthead.head.arkit import ArkitMap
from cvthead.head.model import HeadModel

YAWS = (-60, -40, -20, 0, 20, 40, 60)
PITCHES = (-20, 20)
EXPRESSIONS = {
    "jaw open": {"jawOpen": 0.7},
    "smile": {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9},
    "eyes shut": {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    "look left": {"eyeLookOutLeft": 0.8, "eyeLookInRight": 0.8},
    "brows up": {"browInnerUp": 0.9, "browOuterUpLeft": 0.9, "browOuterUpRight": 0.9},
}


def poses(arkit: ArkitMap, source: Coefficients) -> dict[str, Coefficients]:
    """Title -> coefficients with the source's shape; facing the camera unless the title says so."""
    neutral = replace(Coefficients.zeros(), shape=source.shape)
    series = {f"yaw {yaw}": turned(neutral, yaw=yaw) for yaw in YAWS}
    series |= {f"pitch {pitch}": turned(neutral, pitch=pitch) for pitch in PITCHES}
    for title, scores in EXPRESSIONS.items():
        series[title] = replace(arkit.to_coefficients(scores), shape=source.shape)
    return series


def turned(coefficients: Coefficients, *, yaw: float = 0, pitch: float = 0) -> Coefficients:
    """With the whole head turned by degrees about one axis."""
    return coefficients.with_joints({"global": np.radians([pitch, yaw, 0])})


def sweep(
    head: HeadModel, arkit: ArkitMap, source: Coefficients, camera: Camera, draw: Draw
) -> dict[str, Image]:
    """Title -> picture on white, each in its own head crop.

    Args:
        camera: of the source in its crop; only the scale matters.
    """
    pictures = {}
    for title, coefficients in poses(arkit, source).items():
        crop = head_crop(head, coefficients, camera)
        pictures[title] = draw(coefficients, camera.in_crop(crop)).on_white
    return pictures
