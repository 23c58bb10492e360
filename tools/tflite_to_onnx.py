"""Convert a float TFLite network to ONNX: the operators of MediaPipe's face networks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import tflite
from numpy.typing import NDArray

from tools.onnx_builder import TO_FIRST, Builder, Layout
from tools.tflite_graph import Operator, read_graph

UNARY = {"RELU": "Relu", "LOGISTIC": "Sigmoid", "SQRT": "Sqrt", "NEG": "Neg"}
BINARY = {"ADD": "Add", "SUB": "Sub", "MUL": "Mul", "DIV": "Div", "SQUARED_DIFFERENCE": "Sub"}
CONVOLUTIONS = ("CONV_2D", "DEPTHWISE_CONV_2D")


def convert(contents: bytes) -> bytes:
    """Contents of a .tflite file -> contents of an .onnx file, the same on every run.

    Raises:
        NotImplementedError: an operator or option that MediaPipe's face networks do not use.
    """
    graph = read_graph(contents)
    builder = Builder(graph)
    for i in graph.inputs:
        builder.put(i, graph.tensors[i].name)
    for operator in graph.operators:
        _converter(operator.kind)(builder, operator)
    return builder.finish()


def _same_padding(
    sizes: tuple[int, ...], kernel: tuple[int, ...], strides: list[int], dilations: list[int]
) -> list[int]:
    """TFLite's SAME over (height, width) as ONNX's top, left, bottom, right."""
    begin, end = [], []
    for size, taps, stride, dilation in zip(sizes, kernel, strides, dilations, strict=True):
        reach = (taps - 1) * dilation + 1
        total = max((-(-size // stride) - 1) * stride + reach - size, 0)
        begin.append(total // 2)
        end.append(total - total // 2)
    return begin + end


def _convolution(b: Builder, op: Operator) -> None:
    options, source = op.options, op.inputs[0]
    depthwise = op.kind == "DEPTHWISE_CONV_2D"
    # TFLite: (out, h, w, in), or (1, h, w, channels) where depthwise.
    weights = b.weights(op.inputs[1]).transpose((3, 0, 1, 2) if depthwise else TO_FIRST)
    strides = [options.StrideH(), options.StrideW()]
    dilations = [options.DilationHFactor(), options.DilationWFactor()]
    pads = [0, 0, 0, 0]
    if options.Padding() == tflite.Padding.SAME:
        pads = _same_padding(b.shape(source)[1:3], weights.shape[2:], strides, dilations)
    elif source in b.padded:
        source, pads = b.padded[source]
    parameters = [b.constant(weights), *(b.get(i) for i in op.inputs[2:])]
    result = b.node(
        "Conv",
        b.get(source, "channels_first"),
        *parameters,
        strides=strides,
        dilations=dilations,
        pads=pads,
        group=b.shape(source)[3] if depthwise else 1,
    )
    result = b.activated(result, options.FusedActivationFunction())
    b.put(op.outputs[0], result, "channels_first")


def _transposed_convolution(b: Builder, op: Operator) -> None:
    """MediaPipe's custom operator; in the selfie network kernel 2 x 2, stride 2, no padding."""
    source, weights, bias = op.inputs
    kernel = b.weights(weights)
    height, width = b.shape(source)[1:3]
    if kernel.shape[1:3] != (2, 2) or b.shape(op.outputs[0])[1:3] != (2 * height, 2 * width):
        raise NotImplementedError(f"{op.kind} other than 2 x 2 with stride 2")
    image = b.get(source, "channels_first")
    kernel_name = b.constant(kernel.transpose(3, 0, 1, 2))
    result = b.node("ConvTranspose", image, kernel_name, b.get(bias), strides=[2, 2])
    b.put(op.outputs[0], result, "channels_first")


def _pool(b: Builder, op: Operator) -> None:
    options, image = op.options, b.get(op.inputs[0], "channels_first")
    size = b.shape(op.inputs[0])[1:3]
    kernel = (options.FilterHeight(), options.FilterWidth())
    strides = [options.StrideH(), options.StrideW()]
    if op.kind == "AVERAGE_POOL_2D":
        if kernel != size or b.shape(op.outputs[0])[1:3] != (1, 1):
            raise NotImplementedError("average pooling over less than the image")
        result = b.node("GlobalAveragePool", image)
    else:
        same = options.Padding() == tflite.Padding.SAME
        pads = _same_padding(size, kernel, strides, [1, 1]) if same else [0, 0, 0, 0]
        result = b.node("MaxPool", image, kernel_shape=kernel, strides=strides, pads=pads)
    result = b.activated(result, options.FusedActivationFunction())
    b.put(op.outputs[0], result, "channels_first")


def _prelu(b: Builder, op: Operator) -> None:
    """As depthwise convolutions and Relu: onnxruntime's PRelu leaves the blocked layout, twice
    as slow for the whole landmark network.
    """
    slope = b.weights(op.inputs[1]).astype(np.float32)
    channels = slope.shape[-1]
    if slope.size != channels:
        raise NotImplementedError("PRELU with one slope per pixel")
    slope = slope.reshape(channels, 1, 1, 1)
    x = b.get(op.inputs[0], "channels_first")

    def scaled(value: str, factor: NDArray[np.float32]) -> str:
        name = b.constant(factor)
        return b.node("Conv", value, name, group=channels, kernel_shape=[1, 1])

    if (slope <= 1).all():  # x + max((a - 1) x, 0): the second term is 0 for positive x
        bend = b.node("Relu", scaled(x, slope - 1))
    else:  # x + (1 - a) max(-x, 0)
        bend = scaled(b.node("Relu", scaled(x, -np.ones_like(slope))), 1 - slope)
    b.put(op.outputs[0], b.node("Add", x, bend), "channels_first")


def _pad(b: Builder, op: Operator) -> None:
    source, amounts = op.inputs[0], b.weights(op.inputs[1])
    users = [other.kind for other in b.graph.operators if op.outputs[0] in other.inputs]
    if not amounts[[0, 3]].any() and all(kind in CONVOLUTIONS for kind in users):
        b.padded[op.outputs[0]] = source, [int(n) for n in amounts[1:3].T.ravel()]
        return
    ordered = amounts[list(TO_FIRST)].T.ravel().astype(np.int64)
    result = b.node("Pad", b.get(source, "channels_first"), b.constant(ordered))
    b.put(op.outputs[0], result, "channels_first")


def _unary(b: Builder, op: Operator) -> None:
    layout = b.layout(op.inputs[0])
    x = b.get(op.inputs[0], layout)
    if op.kind == "HARD_SWISH":
        result = b.node("Mul", x, b.node("HardSigmoid", x, alpha=1 / 6, beta=0.5))
    elif op.kind == "RSQRT":
        result = b.node("Reciprocal", b.node("Sqrt", x))
    else:
        result = b.node(UNARY[op.kind], x)
    b.put(op.outputs[0], result, layout)


def _binary(b: Builder, op: Operator) -> None:
    computed = [i for i in op.inputs if b.graph.tensors[i].constant is None]
    first = any(b.layout(i) == "channels_first" for i in computed)
    layout: Layout = "channels_first" if first else "as_is"

    def operand(i: int) -> str:
        if i in computed:
            return b.get(i, layout)
        constant = b.weights(i)
        if first and constant.ndim == 1:
            constant = constant.reshape(-1, 1, 1)
        elif first and constant.ndim:
            raise NotImplementedError(f"{op.kind} with a {constant.shape} constant")
        return b.constant(constant)

    result = b.node(BINARY[op.kind], *map(operand, op.inputs))
    if op.kind == "SQUARED_DIFFERENCE":
        result = b.node("Mul", result, result)
    else:
        result = b.activated(result, op.options.FusedActivationFunction())
    b.put(op.outputs[0], result, layout)


def _reduce(b: Builder, op: Operator) -> None:
    if not op.options.KeepDims():
        raise NotImplementedError(f"{op.kind} that drops dimensions")
    layout, rank = b.layout(op.inputs[0]), len(b.shape(op.inputs[0]))
    axes = [int(axis) % rank for axis in np.atleast_1d(b.weights(op.inputs[1]))]
    if layout == "channels_first":
        axes = [TO_FIRST.index(axis) for axis in axes]
    kind = "ReduceMean" if op.kind == "MEAN" else "ReduceSum"
    axes_name = b.constant(np.array(axes, np.int64))
    b.put(op.outputs[0], b.node(kind, b.get(op.inputs[0], layout), axes_name, keepdims=1), layout)


def _reshape(b: Builder, op: Operator) -> None:
    shape = b.constant(np.array(b.shape(op.outputs[0]), np.int64))
    b.put(op.outputs[0], b.node("Reshape", b.get(op.inputs[0]), shape))


def _transpose(b: Builder, op: Operator) -> None:
    order = [int(axis) for axis in b.weights(op.inputs[1])]
    b.put(op.outputs[0], b.node("Transpose", b.get(op.inputs[0]), perm=order))


def _concatenation(b: Builder, op: Operator) -> None:
    axis = op.options.Axis() % len(b.shape(op.outputs[0]))
    b.put(op.outputs[0], b.node("Concat", *map(b.get, op.inputs), axis=axis))


def _strided_slice(b: Builder, op: Operator) -> None:
    options, source = op.options, op.inputs[0]
    if options.NewAxisMask() or options.EllipsisMask():
        raise NotImplementedError("STRIDED_SLICE with a new axis or an ellipsis")
    begin, end, step = (b.weights(i).astype(np.int64) for i in op.inputs[1:])
    for axis, size in enumerate(b.shape(source)):
        begin[axis] = 0 if options.BeginMask() >> axis & 1 else begin[axis]
        end[axis] = size if options.EndMask() >> axis & 1 else end[axis]
        end[axis] = begin[axis] + 1 if options.ShrinkAxisMask() >> axis & 1 else end[axis]
    limits = (b.constant(a) for a in (begin, end, np.arange(len(begin), dtype=np.int64), step))
    result = b.node("Slice", b.get(source), *limits)
    if options.ShrinkAxisMask():
        shape = b.constant(np.array(b.shape(op.outputs[0]), np.int64))
        result = b.node("Reshape", result, shape)
    b.put(op.outputs[0], result)


def _resize(b: Builder, op: Operator) -> None:
    mode = "asymmetric"
    if op.options.AlignCorners():
        mode = "align_corners"
    elif op.options.HalfPixelCenters():
        mode = "half_pixel"
    height, width = b.weights(op.inputs[1])
    sizes = b.constant(np.array([1, b.shape(op.inputs[0])[3], height, width], np.int64))
    image = b.get(op.inputs[0], "channels_first")
    attributes = {"mode": "linear", "coordinate_transformation_mode": mode}
    b.put(op.outputs[0], b.node("Resize", image, "", "", sizes, **attributes), "channels_first")


def _converter(kind: str) -> Callable[[Builder, Operator], None]:
    converters: dict[str, Callable[[Builder, Operator], None]] = {
        **dict.fromkeys(CONVOLUTIONS, _convolution),
        **dict.fromkeys(("MAX_POOL_2D", "AVERAGE_POOL_2D"), _pool),
        **dict.fromkeys((*UNARY, "HARD_SWISH", "RSQRT"), _unary),
        **dict.fromkeys(BINARY, _binary),
        **dict.fromkeys(("MEAN", "SUM"), _reduce),
        "Convolution2DTransposeBias": _transposed_convolution,
        "CONCATENATION": _concatenation,
        "PAD": _pad,
        "PRELU": _prelu,
        "RESHAPE": _reshape,
        "RESIZE_BILINEAR": _resize,
        "STRIDED_SLICE": _strided_slice,
        "TRANSPOSE": _transpose,
    }
    if kind not in converters:
        raise NotImplementedError(f"operator {kind}")
    return converters[kind]
