"""Milliseconds of the official preset's stages; see cvthead/benchmark.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvthead.benchmark import (
    BASELINE_RUNS,
    ENCODES,
    WARM_UP,
    Stopwatch,
    time_formats,
    turning,
)
from cvthead.camera import CROP_PIXELS
from cvthead.controls import resolve
from cvthead.official.avatar import OfficialAvatar
from cvthead.official.background import without_person
from cvthead.official.networks import picture_array
from cvthead.official.painted import Painted
from cvthead.official.pipeline import OfficialPipeline


def time_encode(
    pipeline: OfficialPipeline, image: NDArray[np.uint8], number: int | None = None
) -> dict[str, dict[str, float]]:
    """Stages of turning a portrait into an avatar."""
    watch = Stopwatch()
    for _ in range(1 + ENCODES):
        picture = watch.time("track", pipeline.tracker.picture, image, face=number)
        pixels = picture_array(picture.pixels)
        mask = watch.time("parsing", pipeline.mask, pixels)
        watch.time("hair", pipeline.offsets, pixels)
        watch.time("DECA", pipeline.tracker.estimate, picture.pixels, picture.square)
        avatar = watch.time("all of encode", pipeline.encode, image, face=number)
        points = pipeline.pose(avatar, avatar.coefficients, avatar.camera)
        watch.time("describe", pipeline.describe, pixels, mask, points)
        watch.time("background", without_person, picture.pixels, mask[0, 0] > 0)
    times = watch.summary(skipped=1)
    return times | {"all of encode": times.pop("all of encode")}


def time_render(
    pipeline: OfficialPipeline, avatar: OfficialAvatar, count: int
) -> dict[str, dict[str, float]]:
    """Stages of a frame from coefficients, and of the picture formats."""
    watch = Stopwatch()
    for controls in turning(WARM_UP + count):
        pose = resolve(avatar.coefficients, avatar.camera, controls, pipeline.arkit)
        points = watch.time("pose", pipeline.pose, avatar, *pose)
        splat = watch.time("splat", pipeline.splat, avatar, points)
        (raw,) = watch.time("U-Net", pipeline.networks.unet, splat)
        watch.time("to frame", Painted(raw[0]).frame)
        time_formats(watch, watch.time("all of render", pipeline.render, avatar, controls))
    return watch.summary(skipped=WARM_UP)


def time_torch(
    folder: Path, avatar: OfficialAvatar, points: NDArray[np.float32], threads: int
) -> dict[str, dict[str, float]]:
    """Splat and U-Net in eager float32 PyTorch, source encoded once.

    Args:
        folder: of the import.
        avatar: of it.
        points: (5023, 3) driven projections.
        threads: of PyTorch.

    Raises:
        ImportError: PyTorch is not installed (extra ``train``).
    """
    import torch

    from cvthead.official.torch_networks import TorchNetworks

    torch.set_num_threads(threads)
    watch = Stopwatch()
    network = TorchNetworks.load(folder).network
    projected = torch.from_numpy(points)[None]
    descriptors = torch.from_numpy(avatar.descriptors)[None]
    with torch.inference_mode():
        for _ in range(WARM_UP + BASELINE_RUNS):
            watch.time("official preset", network.paint, projected, descriptors, CROP_PIXELS)
    return watch.summary(skipped=WARM_UP)
