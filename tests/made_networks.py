"""Small ONNX networks with seeded weights, in the place of those that a user brings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SIZE = 256


def features(path: Path, count: int, *, size: int = SIZE) -> Path:
    """Convolution with random weights, then the mean over the picture: (1, count, 1, 1)."""
    weights = np.random.default_rng(0).normal(size=(count, 3, 8, 8)).astype(np.float32)
    nodes = [
        helper.make_node("Conv", ["x0", "w"], ["c"], strides=[8, 8]),
        helper.make_node("Relu", ["c"], ["r"]),
        helper.make_node("GlobalAveragePool", ["r"], ["y"]),
    ]
    return _save(path, nodes, 1, weights, size)


def distance(path: Path) -> Path:
    """Mean absolute difference of two pictures times a weight: (1, 1, 1, 1)."""
    nodes = [
        helper.make_node("Sub", ["x0", "x1"], ["d"]),
        helper.make_node("Abs", ["d"], ["a"]),
        helper.make_node("Mul", ["a", "w"], ["m"]),
        helper.make_node("ReduceMean", ["m"], ["y"], axes=[1, 2, 3], keepdims=1),
    ]
    return _save(path, nodes, 2, np.array([0.5], np.float32), SIZE)


def _save(
    path: Path, nodes: Sequence[onnx.NodeProto], inputs: int, weights: np.ndarray, size: int
) -> Path:
    picture = [1, 3, size, size]
    graph = helper.make_graph(
        nodes,
        "seeded",
        [helper.make_tensor_value_info(f"x{i}", TensorProto.FLOAT, picture) for i in range(inputs)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(weights, "w")],
    )
    opset = helper.make_opsetid("", 17)
    onnx.save(helper.make_model(graph, opset_imports=[opset], ir_version=9), path)
    return path
