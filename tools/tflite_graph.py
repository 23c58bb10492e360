"""TFLite flatbuffer -> plain operators and tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import tflite
from numpy.typing import NDArray

ELEMENT_TYPES = {
    tflite.TensorType.FLOAT32: np.float32,
    tflite.TensorType.FLOAT16: np.float16,
    tflite.TensorType.INT32: np.int32,
}
OPERATOR_NAMES = {
    code: name for name, code in vars(tflite.BuiltinOperator).items() if isinstance(code, int)
}
OPTIONS = {
    "ADD": tflite.AddOptions,
    "AVERAGE_POOL_2D": tflite.Pool2DOptions,
    "CONCATENATION": tflite.ConcatenationOptions,
    "CONV_2D": tflite.Conv2DOptions,
    "DEPTHWISE_CONV_2D": tflite.DepthwiseConv2DOptions,
    "DIV": tflite.DivOptions,
    "MAX_POOL_2D": tflite.Pool2DOptions,
    "MEAN": tflite.ReducerOptions,
    "MUL": tflite.MulOptions,
    "RESIZE_BILINEAR": tflite.ResizeBilinearOptions,
    "STRIDED_SLICE": tflite.StridedSliceOptions,
    "SUB": tflite.SubOptions,
    "SUM": tflite.ReducerOptions,
}


@dataclass(frozen=True)
class Tensor:
    """``constant`` is None for a value computed at run time."""

    name: str
    shape: tuple[int, ...]
    constant: NDArray[Any] | None


@dataclass(frozen=True)
class Operator:
    """``kind`` is the built-in name, or the custom code; ``options`` the flatbuffer table."""

    kind: str
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    options: Any


@dataclass(frozen=True)
class Graph:
    tensors: tuple[Tensor, ...]
    operators: tuple[Operator, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]


def read_graph(contents: bytes) -> Graph:
    """Read the only subgraph of a .tflite file.

    Float16 constants behind a DEQUANTIZE become float32 constants, which is exact.

    Raises:
        ValueError: several subgraphs.
        KeyError: an element type other than float32, float16 and int32.
    """
    model = tflite.Model.GetRootAsModel(contents, 0)
    if model.SubgraphsLength() != 1:
        raise ValueError(f"expected one subgraph, found {model.SubgraphsLength()}")
    subgraph = model.Subgraphs(0)
    tensors = [_tensor(model, subgraph.Tensors(i)) for i in range(subgraph.TensorsLength())]
    operators = []
    for i in range(subgraph.OperatorsLength()):
        operator = _operator(model, subgraph.Operators(i))
        if operator.kind == "DEQUANTIZE":
            (source,), (target,) = operator.inputs, operator.outputs
            half = tensors[source].constant
            assert half is not None
            tensors[target] = Tensor("", tensors[target].shape, half.astype(np.float32))
        else:
            operators.append(operator)
    return Graph(
        tuple(tensors),
        tuple(operators),
        tuple(map(int, subgraph.InputsAsNumpy())),
        tuple(map(int, subgraph.OutputsAsNumpy())),
    )


def _tensor(model: tflite.Model, tensor: tflite.Tensor) -> Tensor:
    shape = tuple(int(tensor.Shape(i)) for i in range(tensor.ShapeLength()))
    buffer = model.Buffers(tensor.Buffer())
    constant = None
    if buffer.DataLength():
        data = buffer.DataAsNumpy().tobytes()
        constant = np.frombuffer(data, ELEMENT_TYPES[tensor.Type()]).reshape(shape)
    return Tensor(tensor.Name().decode().split(":")[0], shape, constant)


def _operator(model: tflite.Model, operator: tflite.Operator) -> Operator:
    code = model.OperatorCodes(operator.OpcodeIndex())
    # Old files have the small, deprecated field only.
    kind = OPERATOR_NAMES[max(code.BuiltinCode(), code.DeprecatedBuiltinCode())]
    if kind == "CUSTOM":
        kind = code.CustomCode().decode()
    options = None
    if kind in OPTIONS:
        table = operator.BuiltinOptions()
        options = OPTIONS[kind]()
        options.Init(table.Bytes, table.Pos)
    inputs = tuple(int(i) for i in operator.InputsAsNumpy() if i >= 0)
    outputs = tuple(map(int, operator.OutputsAsNumpy()))
    return Operator(kind, inputs, outputs, options)
