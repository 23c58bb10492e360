"""PyTorch modules as ONNX files, compared with torch after export."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cvthead.errors import AssetError

OPSET = 18
EXPORT_HINT = "look for an operator that the exporter translates differently"


def export_graph(
    graph: nn.Module,
    inputs: Mapping[str, Tensor],
    path: Path,
    *,
    outputs: Sequence[str] = ("out",),
    dynamic: dict[str, Any] | None = None,
) -> None:
    """Write ``graph`` in evaluation mode.

    Args:
        graph: takes the inputs in their order.
        inputs: name -> example.
        path: the file to write.
        outputs: their names.
        dynamic: input name -> its dynamic axes, as torch.export has them.
    """
    with warnings.catch_warnings(), _quiet():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            graph.eval(),
            tuple(inputs.values()),
            path,
            input_names=list(inputs),
            output_names=list(outputs),
            opset_version=OPSET,
            dynamic_shapes=dynamic,
            dynamo=True,
            external_data=False,
            verbose=False,
        )


def check_graph(
    path: Path,
    inputs: Mapping[str, Tensor],
    expected: Sequence[Tensor],
    tolerances: Sequence[float],
) -> None:
    """Run the file on the inputs of its export.

    Raises:
        AssetError: an output differs from the expected one by more than its tolerance.
    """
    session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    feed = {name: value.numpy() for name, value in inputs.items()}
    outputs = zip(session.run(None, feed), expected, tolerances, strict=True)
    for found, wanted, tolerance in outputs:
        compare(path.name, found, wanted, tolerance, EXPORT_HINT)


def compare(name: str, found: NDArray[Any], expected: Tensor, tolerance: float, hint: str) -> None:
    """Refuse arrays that differ.

    Raises:
        AssetError: by more than the tolerance, or one of them holds NaN.
    """
    difference = float(np.abs(found.astype(np.float32) - expected.float().numpy()).max())
    if not difference <= tolerance:
        raise AssetError(
            f"{name} differs from torch by {difference:g}, allowed {tolerance:g}", hint=hint
        )


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's notes on libraries that are not installed."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
