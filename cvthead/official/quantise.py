"""The U-Net in 8 bits, calibrated on the sample portrait, and the gate that it has to pass."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from cvthead.coefficients import EXPRESSION_SIZE
from cvthead.controls import Controls, resolve
from cvthead.images import read_image
from cvthead.official.manifest import MIN_UNET_PSNR, UNET_INT8_ONNX, UNET_ONNX
from cvthead.official.networks import Network
from cvthead.official.painted import Painted
from cvthead.official.pipeline import OfficialPipeline
from cvthead.runtime.sessions import open_session
from cvthead.runtime.threads import cores
from cvthead.sample import SAMPLE
from cvthead.training.static_int8 import (
    Feed,
    Overrides,
    concatenated,
    largest,
    override,
    psnr,
    quantise_network,
)

CALIBRATION, HELD_OUT = 8, 4
SEED = 5
INPUT = "splat"
LARGEST_TURN = np.array([0.3, 0.7, 0.3])  # radians
LARGEST_JAW = 0.4

Array = NDArray[np.float32]


def quantise_unet(folder: Path) -> float:
    """Write the 8-bit U-Net of an import beside the float one, if it is close enough.

    Both paint the sample portrait in poses that were not calibrated on.

    Returns:
        The lowest PSNR in dB of their pictures; the file is there if it is MIN_UNET_PSNR or more.
    """
    pipeline = OfficialPipeline.load(folder, precision="float32")
    views = sample_views(pipeline, CALIBRATION + HELD_OUT)
    return write_if_close(folder, views[:CALIBRATION], views[CALIBRATION:])


def write_if_close(folder: Path, calibration: Sequence[Array], held_out: Sequence[Array]) -> float:
    """:func:`quantise_unet` on given views (1, 256, 256, channels)."""
    data = quantised(folder / UNET_ONNX, calibration).SerializeToString()
    exact, small = (
        Network(open_session(source, cores()), keeps_memory=True)
        for source in (str(folder / UNET_ONNX), data)
    )
    lowest = min(
        psnr(*(Painted(network(view)[0][0]).frame().rgba() for network in (exact, small)))
        for view in held_out
    )
    if lowest >= MIN_UNET_PSNR:
        (folder / UNET_INT8_ONNX).write_bytes(data)
    return lowest


def quantised(source: Path, views: Sequence[Array]) -> onnx.ModelProto:
    """The 8-bit network of a float one, with ranges from the views (1, 256, 256, channels)."""
    feeds = [{INPUT: view} for view in views]
    return quantise_network(source, feeds, partial(_overrides, feeds=feeds))


def _overrides(network: onnx.ModelProto, feeds: Sequence[Feed]) -> Overrides:
    groups = concatenated(network)
    highest = largest(network, sorted({name for group in groups for name in group}), feeds)
    overrides: Overrides = {}
    for group in groups:
        overrides |= dict.fromkeys(group, override(max(highest[n] for n in group) / 255, 0))
    return overrides


def sample_views(pipeline: OfficialPipeline, count: int) -> list[Array]:
    """What the U-Net reads of the sample portrait and of its mirror image, in seeded poses."""
    portrait = read_image(SAMPLE)
    avatars = [pipeline.encode(image) for image in (portrait, portrait[:, ::-1].copy())]
    random = np.random.default_rng(SEED)
    views = []
    for index in range(count):
        avatar = avatars[index % len(avatars)]
        pose = resolve(avatar.coefficients, avatar.camera, moved(random), pipeline.arkit)
        views.append(pipeline.splat(avatar, pipeline.pose(avatar, *pose)))
    return views


def moved(random: np.random.Generator) -> Controls:
    """The head turned by up to 40 degrees, with the mouth open and another expression."""
    turn = random.uniform(-1, 1, 3) * LARGEST_TURN
    return Controls(
        global_rotation=turn,
        jaw=(random.uniform(0, LARGEST_JAW), 0, 0),
        expression=random.normal(size=EXPRESSION_SIZE).clip(-2, 2),
        mode="relative",
    )
