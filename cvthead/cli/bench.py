"""``cvthead bench``: milliseconds of every stage of encoding and rendering."""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvthead import benchmark
from cvthead.cli.portrait import add_portrait_options
from cvthead.errors import InputError
from cvthead.images import read_image
from cvthead.official import benchmark as official_benchmark
from cvthead.official.pipeline import OfficialPipeline
from cvthead.pipeline import Pipeline
from cvthead.runtime.threads import cores

Report = dict[str, Any]

TITLES = {
    "encode": "Once per portrait",
    "render": "Once per frame, from coefficients",
    "drive": "Once per frame, from a driving picture",
    "torch": "Per-frame networks in eager float32 PyTorch",
}


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "bench",
        help="print how long every stage takes",
        description="Print median and 95th percentile of the milliseconds of every stage of "
        "encoding a portrait and of rendering it, and the ratio to PyTorch in the same run when "
        "it is installed. Run it on a quiet machine.",
    )
    add_portrait_options(parser, "portrait", "picture of a face")
    parser.add_argument(
        "--renders", type=int, default=100, metavar="N", help="frames to render (100)"
    )
    parser.add_argument("--threads", type=int, metavar="N", help="of the networks (all cores)")
    parser.add_argument("--json", action="store_true", help="print JSON; see docs/benchmark.md")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    for name in ("renders", "threads"):
        value = getattr(args, name)
        if value is not None and value < 1:
            raise InputError(f"--{name} is {value}", hint="use 1 or more")
    image = read_image(args.portrait)
    threads = args.threads or cores()
    times = time_official if args.preset == "official" else time_open
    report = {"preset": args.preset, "threads": threads}
    report |= times(image, args.face, args.renders, threads)
    report["ratios"] = ratios(report)
    print(json.dumps(report, indent=1) if args.json else table(report))


def time_open(image: NDArray[np.uint8], face: int | None, renders: int, threads: int) -> Report:
    """Stages of the open preset."""
    pipeline = Pipeline.load(threads=threads)
    avatar = pipeline.encode(image, face=face)
    report: Report = {
        "encode": benchmark.time_encode(pipeline, image, face),
        "render": benchmark.time_render(pipeline, avatar, renders),
        "drive": benchmark.time_drive(pipeline, avatar, image, renders),
    }
    try:
        return report | {"torch": benchmark.time_torch(threads)}
    except ImportError:
        return report | {"torch": None}


def time_official(image: NDArray[np.uint8], face: int | None, renders: int, threads: int) -> Report:
    """Stages of the official preset, and the precision of its networks."""
    pipeline = OfficialPipeline.load(threads=threads)
    avatar = pipeline.encode(image, face=face)
    report: Report = {
        "precision": dict(pipeline.networks.precision),
        "encode": official_benchmark.time_encode(pipeline, image, face),
        "render": official_benchmark.time_render(pipeline, avatar, renders),
        "drive": benchmark.time_drive(pipeline, avatar, image, renders),
    }
    points = pipeline.pose(avatar, avatar.coefficients, avatar.camera)
    folder = pipeline.networks.manifest.folder
    try:
        return report | {"torch": official_benchmark.time_torch(folder, avatar, points, threads)}
    except ImportError:
        return report | {"torch": None}


def ratios(report: dict[str, Any]) -> dict[str, float]:
    """How many times faster a frame is than each PyTorch path of the same run."""
    frame = report["render"]["all of render"]["median_ms"]
    baselines = report["torch"] or {}
    return {name: round(times["median_ms"] / frame, 2) for name, times in baselines.items()}


def table(report: dict[str, Any]) -> str:
    facts = {"preset": report["preset"], "threads": report["threads"]}
    facts |= report.get("precision", {})
    lines = [f"{name:<24}{value:>9}" for name, value in facts.items()]
    for key, title in TITLES.items():
        if report[key] is None:
            lines += ["", f"{title}: not installed (pip install 'cvthead[train]')"]
            continue
        lines += ["", f"{title:<42}{'median':>9}{'p95':>10}"]
        lines += [
            f"{stage:<42}{times['median_ms']:9.2f}{times['p95_ms']:10.2f} ms"
            for stage, times in report[key].items()
        ]
    lines += [
        f"{f'a frame is faster than {name} in PyTorch':<42}{ratio:8.1f}x"
        for name, ratio in report["ratios"].items()
    ]
    return "\n".join(lines)
