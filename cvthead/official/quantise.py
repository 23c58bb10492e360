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
    DESCRIBE_ONNX,
    EIGHT_BIT,
    MIN_PSNR,
    UNET_ONNX,
    Manifest,
    write_manifest,
)
from cvthead.official.networks import Network, picture_array
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

SEED = 5
INPUT = "splat"
VIEWS = 10  # to calibrate on
POSES_EACH = 2  # to compare
# Tilt in degrees, factor and addend of the values.
SEEN = ((-8.0, 1.25, 0.0), (10.0, 0.75, -10.0), (0.0, 0.5, 100.0))
UNSEEN = ((15.0, 0.6, 0.0), (-15.0, 0.7, 70.0))
# The rare largest values may saturate: finer steps for all others are worth 1 dB.
RANGE = 0.9
# Convolutions up to the end of the first block: few channels, whose rounding costs 10 dB, and as
# fast in float.
ENCODER_FLOAT = 5
LARGEST_TURN = np.array([0.3, 0.7, 0.3])  # radians
LARGEST_JAW = 0.4

Array = NDArray[np.float32]
Image = NDArray[np.uint8]


def add_eight_bit(folder: Path) -> None:
    """:func:`quantise` a complete model, and let its record vouch for what came of it."""
    model = Manifest.load(folder)
    # Calibrated on what the float networks paint, so that these come first.
    write_manifest(folder, model.sources, quantise(folder), deformation=model.deformation)


def quantise(folder: Path) -> dict[str, float]:
    """Write the 8-bit networks of an import beside the float ones, if they are close enough.

    Calibrated on the sample portrait and altered ones; compared on others, in other poses.

    Returns:
        8-bit file -> lowest PSNR in dB of what it and those before it paint, to the float
        networks' pictures. The file is there if that is MIN_PSNR or more.
    """
    exact = OfficialPipeline.load(folder, precision="float32")
    portrait = read_image(SAMPLE)
    known = [portrait, np.ascontiguousarray(portrait[:, ::-1]), *altered(portrait, SEEN)]
    unseen = altered(portrait, UNSEEN)
    unet = quantised_unet(folder / UNET_ONNX, sample_views(exact, known, VIEWS))
    sources = [source_of(exact, image, exact.encode(image)) for image in known[:2]]
    encoder = quantised_encoder(folder / DESCRIBE_ONNX, sources)
    found, served = {}, exact
    for name, network in ((UNET_ONNX, unet), (DESCRIBE_ONNX, encoder)):
        found[EIGHT_BIT[name]], served = keep_if_close(exact, served, name, network, unseen)
    return found


def keep_if_close(
    exact: OfficialPipeline,
    served: OfficialPipeline,
    name: str,
    network: onnx.ModelProto,
    portraits: Sequence[Image],
) -> tuple[float, OfficialPipeline]:
    """Serve an 8-bit network and write it, if the pictures stay close to the float ones.

    Args:
        exact: in float32.
        served: what has been accepted until now.
        name: of the network that gives way.

    Returns:
        Lowest PSNR in dB; and what is served from now on.
    """
    data = network.SerializeToString()
    part = Network(open_session(data, cores()), keeps_memory=name == UNET_ONNX)
    networks = (
        replace(served.networks, unet=part)
        if name == UNET_ONNX
        else replace(served.networks, describe=part)
    )
    tried = replace(served, networks=networks)
    random = np.random.default_rng(SEED)
    lowest = np.inf
    for image in portraits:
        avatars = exact.encode(image), tried.encode(image)
        for _ in range(POSES_EACH):
            controls = moved(random)
            frames = exact.render(avatars[0], controls), tried.render(avatars[1], controls)
            lowest = min(lowest, psnr(*(frame.rgba() for frame in frames)))
    if lowest < MIN_PSNR:
        return float(lowest), served
    (exact.networks.manifest.folder / EIGHT_BIT[name]).write_bytes(data)
    return float(lowest), tried


def quantised_encoder(source: Path, feeds: Sequence[Feed]) -> onnx.ModelProto:
    """The 8-bit image encoder of a float one, with ranges from :func:`source_of`."""
    # The transformer behind the convolutions takes a thirtieth of the time and stays in float.
    return quantise_network(source, feeds, operators=["Conv"], first=ENCODER_FLOAT)


def quantised_unet(source: Path, views: Sequence[Array]) -> onnx.ModelProto:
    """The 8-bit network of a float one, with ranges from the views (1, 256, 256, channels)."""
    feeds = [{INPUT: view} for view in views]
    return quantise_network(source, feeds, partial(_overrides, feeds=feeds))


def _overrides(network: onnx.ModelProto, feeds: Sequence[Feed]) -> Overrides:
    groups = concatenated(network)
    highest = largest(network, sorted({name for group in groups for name in group}), feeds)
    overrides: Overrides = {}
    for group in groups:
        scale = RANGE * max(highest[n] for n in group) / 255
        overrides |= dict.fromkeys(group, override(scale, 0))
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


def altered(portrait: Image, alterations: Sequence[tuple[float, float, float]]) -> list[Image]:
    """A portrait tilted (degrees) and its values times a factor plus an addend (0..255)."""
    height, width = portrait.shape[:2]
    images = []
    for tilt, factor, addend in alterations:
        turn = cv2.getRotationMatrix2D((width / 2, height / 2), tilt, 1)
        tilted = cv2.warpAffine(portrait, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
        changed = cv2.convertScaleAbs(tilted, alpha=factor, beta=addend)
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
