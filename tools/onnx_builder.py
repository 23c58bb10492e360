"""An ONNX graph as it grows out of a TFLite one, with bookkeeping of layouts.

Four-dimensional values are channels-last in TFLite and channels-first in most ONNX operators;
every value keeps the layout in which it was made, and a Transpose is added only where an operator
needs the other one. Float32 constants that float16 represents exactly are stored as float16.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import onnx
import tflite
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from tools.tflite_graph import Graph

Layout = Literal["channels_first", "as_is"]
OPSET = 18
IR_VERSION = 9
TO_FIRST = (0, 3, 1, 2)
TO_LAST = (0, 2, 3, 1)


@dataclass
class Builder:
    """The ONNX graph as it grows; ``values`` maps a TFLite tensor to its names by layout."""

    graph: Graph
    nodes: list[onnx.NodeProto] = field(default_factory=list)
    initializers: list[onnx.TensorProto] = field(default_factory=list)
    values: dict[int, dict[Layout, str]] = field(default_factory=dict)
    # Padding (top, left, bottom, right) and source of tensors whose PAD the convolution absorbs.
    padded: dict[int, tuple[int, list[int]]] = field(default_factory=dict)
    names: int = 0

    def name(self) -> str:
        self.names += 1
        return f"v{self.names}"

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        name = self.name()
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def constant(self, array: NDArray[Any]) -> str:
        array, name = np.ascontiguousarray(array), self.name()
        half = array.astype(np.float16)
        # Below nine elements the extra Cast node is larger than what it saves.
        is_half = array.size > 8 and np.array_equal(half.astype(np.float32), array)
        if array.dtype == np.float32 and is_half:
            self.initializers.append(numpy_helper.from_array(half, name))
            return self.node("Cast", name, to=TensorProto.FLOAT)
        self.initializers.append(numpy_helper.from_array(array, name))
        return name

    def shape(self, tensor: int) -> tuple[int, ...]:
        return self.graph.tensors[tensor].shape

    def weights(self, tensor: int) -> NDArray[Any]:
        constant = self.graph.tensors[tensor].constant
        if constant is None:
            raise NotImplementedError(f"{self.graph.tensors[tensor].name} is not a constant")
        return constant

    def get(self, tensor: int, layout: Layout = "as_is") -> str:
        if self.graph.tensors[tensor].constant is not None:
            return self.constant(self.weights(tensor))
        known = self.values[tensor]
        if len(self.shape(tensor)) != 4:
            layout = "as_is"
        if layout not in known:
            (other,) = known.values()
            order = TO_FIRST if layout == "channels_first" else TO_LAST
            known[layout] = self.node("Transpose", other, perm=order)
        return known[layout]

    def layout(self, tensor: int) -> Layout:
        """The layout in which the value was made."""
        return next(iter(self.values[tensor]))

    def put(self, tensor: int, name: str, layout: Layout = "as_is") -> None:
        self.values[tensor] = {layout: name}

    def activated(self, name: str, activation: int) -> str:
        if activation == tflite.ActivationFunctionType.NONE:
            return name
        if activation == tflite.ActivationFunctionType.RELU:
            return self.node("Relu", name)
        if activation == tflite.ActivationFunctionType.RELU6:
            limits = (self.constant(np.array(limit, np.float32)) for limit in (0, 6))
            return self.node("Clip", name, *limits)
        raise NotImplementedError(f"activation {activation}")

    def finish(self) -> bytes:
        """The checked ONNX file; names, order, shapes and layout of inputs and outputs are kept."""
        for i in self.graph.outputs:
            name = self.graph.tensors[i].name
            self.nodes.append(helper.make_node("Identity", [self.get(i)], [name]))
        inputs, outputs = map(self._ports, (self.graph.inputs, self.graph.outputs))
        graph = helper.make_graph(self.nodes, "g", inputs, outputs, self.initializers)
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION)
        onnx.checker.check_model(model)
        contents: bytes = model.SerializeToString(deterministic=True)
        return contents

    def _ports(self, tensors: tuple[int, ...]) -> list[onnx.ValueInfoProto]:
        chosen = [self.graph.tensors[i] for i in tensors]
        return [helper.make_tensor_value_info(t.name, TensorProto.FLOAT, t.shape) for t in chosen]
