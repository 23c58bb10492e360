"""What an exported network must pass before it is written for use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from torch import Tensor, nn

from cvthead.errors import AssetError
from cvthead.training.onnx_files import check_graph, compare, export_graph


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Tensor], Tensor]:
    """A convolution, its input and PyTorch's answer."""
    torch.manual_seed(0)
    graph = nn.Conv2d(2, 3, 3).eval()
    inputs = {"x": torch.randn(1, 2, 8, 8)}
    path = tmp_path_factory.mktemp("onnx") / "graph.onnx"
    export_graph(graph, inputs, path)
    with torch.inference_mode():
        return path, inputs, graph(inputs["x"])


def test_the_same_answer_passes(exported: tuple[Path, dict[str, Tensor], Tensor]) -> None:
    path, inputs, expected = exported
    check_graph(path, inputs, [expected], [1e-5])


def test_another_answer_is_refused(exported: tuple[Path, dict[str, Tensor], Tensor]) -> None:
    path, inputs, expected = exported
    wrong = expected.clone()
    wrong[0, 1, 2, 3] += 0.01
    with pytest.raises(AssetError, match=r"graph\.onnx differs from torch by 0\.0[01]"):
        check_graph(path, inputs, [wrong], [1e-3])


def test_nan_is_refused() -> None:
    with pytest.raises(AssetError, match="differs from torch by nan"):
        compare("graph", np.array([np.nan]), torch.zeros(1), 1.0, "export again")
