"""``cvthead bench``: milliseconds of every stage of encoding and rendering."""

from __future__ import annotations

import argparse
import json
from typing import Any

from cvthead.benchmark import time_drive, time_encode, time_render, time_torch
from cvthead.cli.portrait import add_portrait_options
from cvthead.errors import InputError
from cvthead.images import read_image
from cvthead.pipeline import Pipeline
from cvthead.runtime.threads import cores

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
    pipeline = Pipeline.load(args.preset, threads=threads)
    avatar = pipeline.encode(image, face=args.face)
    report: dict[str, Any] = {
        "threads": threads,
        "encode": time_encode(pipeline, image, args.face),
        "render": time_render(pipeline, avatar, args.renders),
        "drive": time_drive(pipeline, avatar, image, args.renders),
    }
    try:
        report["torch"] = time_torch(threads)
    except ImportError:
        report["torch"] = None
    report["ratios"] = ratios(report)
    print(json.dumps(report, indent=1) if args.json else table(report))


def ratios(report: dict[str, Any]) -> dict[str, float]:
    """How many times faster a frame is than each PyTorch path of the same run."""
    frame = report["render"]["all of render"]["median_ms"]
    baselines = report["torch"] or {}
    return {name: round(times["median_ms"] / frame, 2) for name, times in baselines.items()}


def table(report: dict[str, Any]) -> str:
    lines = [f"{'threads':<24}{report['threads']:>9}"]
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
