"""U-Net and image encoder in 8 bits, calibrated on the sample portrait, and the gate to pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import onnx
from numpy.typing import NDArray

from cvthead.coefficients import EXPRESSION_SIZE
from cvthead.controls import Controls, resolve
from cvthead.images import read_image
from cvthead.official.avatar import OfficialAvatar
from cvthead.official.manifest import (
    DESCRIBE_INT8_ONNX,
    DESCRIBE_ONNX,
    MIN_PSNR,
    UNET_INT8_ONNX,
    UNET_ONNX,
)
from cvthead.official.networks import Network, picture_array
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
POSES_EACH = 2
# Convolutions up to the end of the first block: few channels, whose rounding costs 10 dB, and as
# fast in float.
ENCODER_FLOAT = 5
ALTERATIONS = ((15.0, 0.6, 0.0), (-15.0, 0.7, 70.0))  # degrees, factor, addend of 0..255

Array = NDArray[np.float32]
Image = NDArray[np.uint8]


def quantise(folder: Path) -> dict[str, float]:
    """Write the 8-bit networks of an import beside the float ones, if they are close enough.

    Calibrated on the sample portrait and its mirror image, compared in other poses and with
    tilted, darkened and pale portraits.

    Returns:
        Lowest PSNR in dB of the pictures by file; the file is there if it is MIN_PSNR or more.
    """
    pipeline = OfficialPipeline.load(folder, precision="float32")
    portrait = read_image(SAMPLE)
    known = portrait, np.ascontiguousarray(portrait[:, ::-1])
    views = sample_views(pipeline, known, CALIBRATION + HELD_OUT)
    unet = write_unet_if_close(folder, views[:CALIBRATION], views[CALIBRATION:])
    sources = [source_of(pipeline, image, pipeline.encode(image)) for image in known]
    encoder = write_encoder_if_close(pipeline, sources, altered(portrait))
    return {UNET_INT8_ONNX: unet, DESCRIBE_INT8_ONNX: encoder}


def write_unet_if_close(
    folder: Path, calibration: Sequence[Array], held_out: Sequence[Array]
) -> float:
    """The U-Net on given views (1, 256, 256, channels); dB of its frames to the float one's."""
    data = quantised_unet(folder / UNET_ONNX, calibration).SerializeToString()
    exact, small = (
        Network(open_session(source, cores()), keeps_memory=True)
        for source in (str(folder / UNET_ONNX), data)
    )
    lowest = min(
        psnr(*(Painted(network(view)[0][0]).frame().rgba() for network in (exact, small)))
        for view in held_out
    )
    if lowest >= MIN_PSNR[UNET_INT8_ONNX]:
        (folder / UNET_INT8_ONNX).write_bytes(data)
    return lowest


def write_encoder_if_close(
    pipeline: OfficialPipeline, calibration: Sequence[Feed], held_out: Sequence[Image]
) -> float:
    """The image encoder; dB of whole frames.

    Args:
        pipeline: in float32.
        calibration: see :func:`source_of`.
        held_out: portraits.
    """
    folder = pipeline.networks.manifest.folder
    # The transformer behind the convolutions takes a thirtieth of the time and stays in float.
    data = quantise_network(
        folder / DESCRIBE_ONNX, calibration, operators=["Conv"], first=ENCODER_FLOAT
    ).SerializeToString()
    encoder = Network(open_session(data, cores()), keeps_memory=False)
    random = np.random.default_rng(SEED)
    lowest = np.inf
    for image in held_out:
        exact = pipeline.encode(image)
        (descriptors,) = encoder(*source_of(pipeline, image, exact).values())
        avatars = exact, replace(exact, descriptors=descriptors[0])
        for _ in range(POSES_EACH):
            controls = moved(random)
            frames = (pipeline.render(avatar, controls).rgba() for avatar in avatars)
            lowest = min(lowest, psnr(*frames))
    if lowest >= MIN_PSNR[DESCRIBE_INT8_ONNX]:
        (folder / DESCRIBE_INT8_ONNX).write_bytes(data)
    return float(lowest)


def quantised_unet(source: Path, views: Sequence[Array]) -> onnx.ModelProto:
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


def sample_views(pipeline: OfficialPipeline, portraits: Sequence[Image], count: int) -> list[Array]:
    """What the U-Net reads of the portraits in seeded poses."""
    avatars = [pipeline.encode(image) for image in portraits]
    random = np.random.default_rng(SEED)
    views = []
    for index in range(count):
        avatar = avatars[index % len(avatars)]
        pose = resolve(avatar.coefficients, avatar.camera, moved(random), pipeline.arkit)
        views.append(pipeline.splat(avatar, pipeline.pose(avatar, *pose)))
    return views


def source_of(pipeline: OfficialPipeline, image: Image, avatar: OfficialAvatar) -> Feed:
    """What the image encoder reads of an avatar's portrait."""
    picture = picture_array(pipeline.tracker.picture(image).pixels)
    points = pipeline.pose(avatar, avatar.coefficients, avatar.camera)
    source = np.concatenate([picture, pipeline.mask(picture)], axis=1)
    return {"source": source, "points": points[None]}


def altered(portrait: Image) -> list[Image]:
    """A portrait tilted and darkened; and tilted the other way, pale."""
    height, width = portrait.shape[:2]
    images = []
    for tilt, gain, shift in ALTERATIONS:
        turn = cv2.getRotationMatrix2D((width / 2, height / 2), tilt, 1)
        tilted = cv2.warpAffine(portrait, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
        changed = cv2.convertScaleAbs(tilted, alpha=gain, beta=shift)
        images.append(np.asarray(changed, np.uint8))
    return images


def moved(random: np.random.Generator) -> Controls:
    """The head turned by up to 40 degrees, with the mouth open and another expression."""
    turn = random.uniform(-1, 1, 3) * LARGEST_TURN
    return Controls(
        global_rotation=turn,
        jaw=(random.uniform(0, LARGEST_JAW), 0, 0),
        expression=random.normal(size=EXPRESSION_SIZE).clip(-2, 2),
        mode="relative",
    )
