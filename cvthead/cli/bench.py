"""``cvthead bench``: milliseconds of every stage of encoding and rendering."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from cvthead.avatar import Avatar
from cvthead.camera import CROP_PIXELS
from cvthead.cli.portrait import add_portrait_options
from cvthead.controls import Controls, resolve
from cvthead.errors import InputError
from cvthead.images import read_image
from cvthead.model.cvthead import to_flow
from cvthead.model.splat import splat
from cvthead.pipeline import Pipeline, without_person
from cvthead.source import cut_head, read_source

P = ParamSpec("P")
T = TypeVar("T")
WARM_UP = 3
ENCODES = 5


class Stopwatch:
    """Collects milliseconds per stage, in the order of first use."""

    def __init__(self) -> None:
        self.samples: dict[str, list[float]] = {}

    def time(self, stage: str, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        start = time.perf_counter()
        result = work(*args, **kwargs)
        self.samples.setdefault(stage, []).append((time.perf_counter() - start) * 1000)
        return result

    def table(self, title: str, skipped: int) -> str:
        """Medians without the first ``skipped`` samples."""
        lines = [
            f"{stage:<22}{statistics.median(times[skipped:]):9.2f} ms"
            for stage, times in self.samples.items()
        ]
        return "\n".join([title, *lines])


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "bench",
        help="print how long every stage takes",
        description="Print the median milliseconds of every stage of encoding a portrait and of "
        "rendering it. Encoding runs once per portrait, rendering once per frame.",
    )
    add_portrait_options(parser, "portrait", "picture of a face")
    parser.add_argument(
        "--renders", type=int, default=100, metavar="N", help="frames to render (100)"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    if args.renders < 1:
        raise InputError(f"--renders is {args.renders}", hint="use 1 or more")
    image = read_image(args.portrait)
    pipeline = Pipeline.load(args.preset)
    print(_encode_table(pipeline, image, args.face))
    print(_render_table(pipeline, pipeline.encode(image, face=args.face), args.renders))


def _encode_table(pipeline: Pipeline, image: NDArray[np.uint8], number: int | None) -> str:
    watch = Stopwatch()
    for _ in range(1 + ENCODES):
        face = watch.time("track", pipeline.tracker.track, image, face=number)
        crop = watch.time("mask", cut_head, pipeline.tracker, image, face)
        source = watch.time("deformation", read_source, pipeline.deformer, pipeline.layout, crop)
        watch.time("describe", pipeline.describe, source)
        watch.time("background", without_person, crop)
        watch.time("all of encode", pipeline.encode, image, face=number)
    return watch.table(f"Once per portrait (median of {ENCODES})", skipped=1)


@torch.inference_mode()
def _render_table(pipeline: Pipeline, avatar: Avatar, count: int) -> str:
    watch = Stopwatch()
    model = pipeline.model
    descriptors = torch.from_numpy(avatar.descriptors.astype(np.float32))[None]
    portrait = torch.from_numpy(avatar.portrait_input)[None]
    for index in range(WARM_UP + count):
        turn = index / (WARM_UP + count) - 0.5
        controls = Controls(global_rotation=(0, turn, 0), arkit={"jawOpen": abs(turn)})
        points = watch.time("pose", _points, pipeline, avatar, controls)
        rows = to_flow(descriptors, points)
        size = CROP_PIXELS // model.config.unet_unshuffle
        image = watch.time("splat", splat, points, rows, size)
        watch.time("warp and U-Net", model.paint_splat, image, portrait)
        frame = watch.time("all of render", pipeline.render, avatar, controls)
        watch.time("composite on colour", frame.over, (255, 255, 255))
    return watch.table(f"Once per frame (median of {count})", skipped=WARM_UP)


def _points(pipeline: Pipeline, avatar: Avatar, controls: Controls) -> torch.Tensor:
    """Driven point projections (1, P, 3): ARKit map, head model, skinning, camera."""
    pose = resolve(avatar.coefficients, avatar.camera, controls, pipeline.arkit)
    return torch.from_numpy(pipeline.pose(avatar, *pose))[None]
