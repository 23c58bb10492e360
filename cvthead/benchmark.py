"""Milliseconds of every stage, and what they are in the plain PyTorch float32 path of this run.

The open preset's stages; cvthead/official/benchmark.py has the official one's.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from cvthead.avatar import Avatar
from cvthead.controls import Controls, resolve
from cvthead.driving import drive
from cvthead.frame import Frame
from cvthead.images import ImageFormat, decode_image, encode_image
from cvthead.pipeline import Pipeline, without_person
from cvthead.preset import AnyAvatar, Preset
from cvthead.source import cut_head, read_source
from cvthead.tracking.tracker import TrackedFace

P = ParamSpec("P")
T = TypeVar("T")
AvatarT = TypeVar("AvatarT", bound=AnyAvatar)

WARM_UP = 3
ENCODES = 5
BASELINE_RUNS = 10
FORMATS: tuple[ImageFormat, ...] = ("png", "jpeg", "webp")


@dataclass
class Stopwatch:
    """Collects milliseconds per stage, in the order of first use."""

    samples: dict[str, list[float]] = field(default_factory=dict)

    def time(self, stage: str, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        start = time.perf_counter()
        result = work(*args, **kwargs)
        self.samples.setdefault(stage, []).append((time.perf_counter() - start) * 1000)
        return result

    def summary(self, skipped: int) -> dict[str, dict[str, float]]:
        """Stage -> median and p95 in milliseconds, without the first ``skipped`` samples."""
        return {
            stage: {
                "median_ms": round(statistics.median(times[skipped:]), 3),
                "p95_ms": round(float(np.percentile(times[skipped:], 95)), 3),
            }
            for stage, times in self.samples.items()
        }


def time_encode(
    pipeline: Pipeline, image: NDArray[np.uint8], number: int | None = None
) -> dict[str, dict[str, float]]:
    """Stages of turning a portrait into an avatar."""
    watch = Stopwatch()
    for _ in range(1 + ENCODES):
        face = watch.time("track", pipeline.tracker.track, image, face=number)
        crop = watch.time("mask", cut_head, pipeline.tracker, image, face)
        source = watch.time("deformation", read_source, pipeline.deformer, pipeline.layout, crop)
        watch.time("describe", pipeline.describe, source)
        watch.time("background", without_person, crop)
        watch.time("all of encode", pipeline.encode, image, face=number)
    return watch.summary(skipped=1)


def time_render(pipeline: Pipeline, avatar: Avatar, count: int) -> dict[str, dict[str, float]]:
    """Stages of a frame from coefficients, and of the picture formats."""
    watch = Stopwatch()
    networks = pipeline.networks
    for controls in turning(WARM_UP + count):
        pose = resolve(avatar.coefficients, avatar.camera, controls, pipeline.arkit)
        points = watch.time("pose", pipeline.pose, avatar, *pose)
        placed = watch.time("splat and warp", pipeline.place, avatar, points)
        watch.time("U-Net", networks.paint, [placed])
        frame = watch.time("all of render", pipeline.render, avatar, controls)
        time_formats(watch, frame)
    return watch.summary(skipped=WARM_UP)


def time_formats(watch: Stopwatch, frame: Frame) -> None:
    """Stages from a frame to a picture file."""
    picture = watch.time("composite on colour", frame.over, (255, 255, 255))
    for name in FORMATS:
        watch.time(f"to {name}", encode_image, picture, name)


def time_drive(
    pipeline: Preset[AvatarT], avatar: AvatarT, image: NDArray[np.uint8], count: int
) -> dict[str, dict[str, float]]:
    """From a driving JPEG to a rendered JPEG, the face known from the frame before."""
    watch = Stopwatch()
    data = encode_image(image, "jpeg")
    previous: TrackedFace | None = None
    for _ in range(WARM_UP + count):
        start = time.perf_counter()
        picture = watch.time("decode JPEG", decode_image, data)
        previous = watch.time("track", _track, pipeline, picture, previous)
        coefficients, camera = drive(pipeline.head, avatar, previous)
        frame = watch.time("render", pipeline.render_coefficients, avatar, coefficients, camera)
        watch.time("to JPEG", encode_image, frame.over((255, 255, 255)), "jpeg")
        watch.samples.setdefault("JPEG to JPEG", []).append((time.perf_counter() - start) * 1000)
    return watch.summary(skipped=WARM_UP)


def _track(
    pipeline: Preset[Any], image: NDArray[np.uint8], previous: TrackedFace | None
) -> TrackedFace:
    shape = None if previous is None else previous.coefficients.shape
    return pipeline.tracker.track(image, shape=shape, previous=previous)


def turning(count: int) -> list[Controls]:
    """A head that turns and opens its mouth."""
    return [
        Controls(global_rotation=(0, turn, 0), arkit={"jawOpen": abs(turn)})
        for turn in np.linspace(-0.5, 0.5, count).tolist()
    ]


def time_torch(threads: int) -> dict[str, dict[str, float]]:
    """The per-frame networks in eager float32 PyTorch, source encoded once: this preset's and
    the paper's. Weights do not change the time, so both are random.

    Raises:
        ImportError: PyTorch is not installed (extra ``train``).
    """
    import torch

    from cvthead.camera import CROP_PIXELS
    from cvthead.head.hierarchy import MeshHierarchy
    from cvthead.head.model import HeadModel
    from cvthead.model.config import OPEN
    from cvthead.model.cvthead import CVTHead
    from cvthead.model.paper import PaperCVTHead
    from cvthead.points import PointLayout

    torch.set_num_threads(threads)
    watch = Stopwatch()
    hierarchy = MeshHierarchy.load()
    layout = PointLayout.of(HeadModel.load())
    ours = CVTHead(OPEN, hierarchy, layout).eval()
    paper = PaperCVTHead(hierarchy).eval()
    warped = torch.zeros(1, 4, CROP_PIXELS, CROP_PIXELS)
    points = torch.rand(1, layout.total, 3) * 2 - 1
    seen = torch.ones(1, layout.total)
    rows = torch.rand(1, layout.total, OPEN.descriptor_size)
    descriptors = torch.rand(1, layout.vertices, paper.config.descriptor_size)
    with torch.inference_mode():
        for _ in range(WARM_UP + BASELINE_RUNS):
            watch.time("open preset", ours.paint, points, rows, seen, warped)
            vertices = points[:, : layout.vertices]
            watch.time("paper preset", paper.paint, vertices, descriptors, CROP_PIXELS)
    return watch.summary(skipped=WARM_UP)
