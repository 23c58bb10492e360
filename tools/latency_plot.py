"""Milliseconds of the frame network by batch and threads, as a table and a picture::

    python -m tools.latency_plot docs/latency.svg > latency.md

Runs the ``open`` preset's U-Net alone, as the service runs it when renders wait, on made input
(its values do not change the time). Prints Markdown; run it on a quiet machine.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import onnxruntime as ort
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cvthead.runtime.model_folder import PAINT, ModelFolder, packaged
from cvthead.runtime.sessions import open_session
from cvthead.runtime.threads import one_thread_per_call

BATCHES, THREADS = (1, 2, 4, 8), (1, 2)
WARM_UP, RUNS = 5, 50
# onnxruntime's names of input types.
TYPES = {"tensor(uint8)": np.uint8, "tensor(float)": np.float32, "tensor(float16)": np.float16}

Timings = Mapping[int, Mapping[int, float]]  # threads -> batch -> milliseconds of the batch


def made_input(session: ort.InferenceSession, batch: int) -> dict[str, NDArray[np.generic]]:
    """Random input of the session's shapes and types with ``batch`` frames."""
    rng = np.random.default_rng(0)
    return {
        one.name: rng.integers(0, 256, (batch, *one.shape[1:])).astype(TYPES[one.type])
        for one in session.get_inputs()
    }


def median_milliseconds(session: ort.InferenceSession, batch: int, runs: int) -> float:
    """Median time of one call with ``batch`` frames."""
    feed = made_input(session, batch)
    times = []
    for _ in range(WARM_UP + runs):
        start = time.perf_counter()
        session.run(None, feed)
        times.append((time.perf_counter() - start) * 1000)
    return statistics.median(times[WARM_UP:])


def measure(threads: Sequence[int], batches: Sequence[int], runs: int) -> Timings:
    network = ModelFolder.load(packaged("open")).read(PAINT)
    timings = {}
    for count in threads:
        session = open_session(network, count)
        timings[count] = {batch: median_milliseconds(session, batch, runs) for batch in batches}
    return timings


def table(timings: Timings) -> str:
    """Markdown: a row for each batch, two columns for each number of threads."""
    names = [f"{count} thread{'s' if count > 1 else ''}" for count in timings]
    lines = [
        "| batch | " + " | ".join(f"{name}: ms | ms a frame" for name in names) + " |",
        "| ---: " * (1 + 2 * len(names)) + "|",
    ]
    for batch in next(iter(timings.values())):
        cells = [f"{row[batch]:.1f} | {row[batch] / batch:.1f}" for row in timings.values()]
        lines.append(f"| {batch} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(timings: Timings, path: Path) -> None:
    """SVG: milliseconds of a batch over the batch, a line for each number of threads."""
    figure = Figure(figsize=(5, 3.2), layout="constrained")
    axes = figure.subplots()
    for count, row in timings.items():
        label = f"{count} thread{'s' if count > 1 else ''}"
        axes.plot(list(row), list(row.values()), marker="o", label=label)
    axes.set_xticks(list(next(iter(timings.values()))))
    axes.set_ylim(bottom=0)
    axes.set_xlabel("frames in a batch")
    axes.set_ylabel("milliseconds")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    # Neither date nor random ids: the same figures give the same file.
    with mpl.rc_context({"svg.hashsalt": "cvthead"}):
        figure.savefig(path, format="svg", metadata={"Date": None})


def main() -> None:
    one_thread_per_call()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("svg", type=Path, help="picture to write")
    parser.add_argument("--runs", type=int, default=RUNS, help="timed calls each (50)")
    arguments = parser.parse_args()
    timings = measure(THREADS, BATCHES, arguments.runs)
    plot(timings, arguments.svg)
    print(table(timings))


if __name__ == "__main__":
    main()
