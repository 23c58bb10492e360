"""``python -m cvthead.evaluation --data ../shared/data -o local/evaluation``"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.errors import CVTHeadError
from cvthead.evaluation.metrics import Metrics
from cvthead.evaluation.page import write_page
from cvthead.evaluation.protocol import Animate, Clip, Draw, Drawn, Evaluator, Image
from cvthead.evaluation.report import Report
from cvthead.evaluation.sweep import sweep
from cvthead.pipeline import Pipeline
from cvthead.runtime.threads import one_thread_per_call
from cvthead.source import HeadCrop


def animate_with(pipeline: Pipeline) -> Animate:
    """The pipeline as the method under test."""

    def animate(image: Image, source: HeadCrop) -> Draw:
        avatar = pipeline.encode(image)

        def draw(coefficients: Coefficients, camera: Camera) -> Drawn:
            frame = pipeline.render_coefficients(avatar, coefficients, camera)
            return Drawn(frame.rgb, frame.alpha.astype(np.float32) / np.float32(255))

        return draw

    return animate


def main(arguments: list[str] | None = None) -> int:
    """Run the evaluation; returns the exit code."""
    one_thread_per_call()
    options = parser().parse_args(arguments)
    paths = sorted((options.data / "clips" / "val").glob("*.mp4"))[:: options.every]
    if not paths:
        print(f"no clips in {options.data / 'clips' / 'val'}", file=sys.stderr)
        return 2
    try:
        evaluate(paths, options.output, options.drivers, options.people, options.model)
    except CVTHeadError as error:
        print(f"{error}. {error.hint}", file=sys.stderr)
        return 1
    return 0


def evaluate(
    paths: list[Path], output: Path, drivers: int, people: int, model: Path | None
) -> Report:
    """Score the clips and write ``index.html``, ``report.md`` and ``report.json`` to a folder."""
    pipeline = Pipeline.load(model=model)
    evaluator = Evaluator(pipeline.tracker, pipeline.deformer, Metrics(), animate_with(pipeline))
    clips: list[Clip] = []
    for path in paths:
        clip = evaluator.clip(path, drivers)
        if clip is None:
            print(f"{path.name}: no trackable face", file=sys.stderr)
            continue
        clips.append(clip)
        print(f"{path.name}: {len(clip.drivers)} frames", file=sys.stderr)
    report = Report.of(clips)
    chosen = clips[:: max(1, len(clips) // people)][:people]
    sweeps = {
        clip.name: sweep(
            pipeline.head,
            pipeline.arkit,
            clip.source.coefficients,
            clip.source.camera,
            clip.draw,
        )
        for clip in chosen
    }
    output.mkdir(parents=True, exist_ok=True)
    (output / "report.md").write_text(report.markdown(), encoding="utf-8")
    (output / "report.json").write_text(
        json.dumps(report.json(), indent=1, allow_nan=False), encoding="utf-8"
    )
    print(report.markdown())
    print(write_page(output, report, chosen, sweeps))
    return report


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser("python -m cvthead.evaluation", description=__doc__)
    result.add_argument("--data", type=Path, required=True, help="folder with clips/val/*.mp4")
    result.add_argument("-o", "--output", type=Path, default=Path("local/evaluation"))
    result.add_argument("--model", type=Path, help="folder of another model than the packaged one")
    result.add_argument("--drivers", type=int, default=8, help="driving frames per clip")
    result.add_argument("--every", type=int, default=1, help="take every n-th clip")
    result.add_argument("--people", type=int, default=8, help="people on the page")
    return result


if __name__ == "__main__":
    raise SystemExit(main())
