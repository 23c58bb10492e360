"""Milliseconds of a network by onnxruntime and by OpenVINO, in turns, as a table::

    pip install openvino
    python -m tools.openvino_compare [NETWORK.onnx ...]

Without arguments the ``open`` preset's frame network. Input is random (it does not change the
time); the last column tells how far OpenVINO's answer is from onnxruntime's. Run it on a quiet
machine.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvthead.runtime.model_folder import PAINT, packaged
from cvthead.runtime.sessions import open_session
from cvthead.runtime.threads import cores
from tools.latency_plot import made_input

WARM_UP, RUNS = 5, 60
PRECISIONS = ("f32", "bf16")  # of what the file does not quantise

Run = Callable[[], NDArray[Any]]


def engines(network: Path, threads: int) -> dict[str, Run]:
    """The network ready to run on the same input, by engine."""
    openvino = import_module("openvino")  # not a dependency: nothing that ships needs it
    session = open_session(network.read_bytes(), threads)
    feed: dict[str, Any] = made_input(session, 1)
    runs: dict[str, Run] = {"onnxruntime": lambda: session.run(None, feed)[0]}
    core = openvino.Core()
    for precision in PRECISIONS:
        model = core.read_model(network)
        model.reshape({name: list(value.shape) for name, value in feed.items()})
        options = {
            "INFERENCE_NUM_THREADS": threads,
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_PRECISION_HINT": precision,
        }
        request = core.compile_model(model, "CPU", options).create_infer_request()
        runs[f"OpenVINO, {precision}"] = lambda request=request: request.infer(feed)[0]  # type: ignore[misc]
    return runs


def measure(network: Path, threads: int) -> list[str]:
    """Rows of the table."""
    runs = engines(network, threads)
    expected = runs["onnxruntime"]().astype(np.float64)
    times: dict[str, list[float]] = {name: [] for name in runs}
    for number in range(WARM_UP + RUNS):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            if number >= WARM_UP:
                times[name].append((time.perf_counter() - begin) * 1000)
    rows = []
    for name, run in runs.items():
        off = np.abs(run() - expected).mean() / max(float(expected.std()), 1e-9)
        p95 = np.percentile(times[name], 95)
        rows.append(
            f"| {network.name} | {threads} | {name} | {statistics.median(times[name]):.1f} "
            f"| {p95:.1f} | {off:.4f} |"
        )
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.openvino_compare", description=__doc__)
    parser.add_argument("networks", type=Path, nargs="*", default=[packaged("open") / PAINT])
    args = parser.parse_args(argv)
    print("| network | threads | engine | median ms | p95 ms | difference, share of the std |")
    print("| --- | ---: | --- | ---: | ---: | ---: |")
    for network in args.networks:
        for threads in sorted({1, cores()}):
            print("\n".join(measure(network, threads)), flush=True)


if __name__ == "__main__":
    main()
