"""The open preset's frame network in 8 bits, calibrated on real splats."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
from onnx import numpy_helper

from cvthead.errors import AssetError
from cvthead.runtime.mix import mix
from cvthead.runtime.place import Placed
from cvthead.runtime.subpixels import unshuffled
from cvthead.training.onnx_export import to_codes
from cvthead.training.static_int8 import (
    Feed,
    Overrides,
    concatenated,
    largest,
    override,
    psnr,
    quantise_network,
)

MIN_PSNR = 40.0


def feed(placed: Placed) -> Feed:
    """A placed frame as the float network reads it."""
    codes = {"splat": placed.codes, "portrait": unshuffled(placed.warped)}
    return {name: x[None].astype(np.float32) for name, x in codes.items()}


def quantise(
    source: Path, output: Path, calibration: Sequence[Placed], held_out: Sequence[Placed]
) -> float:
    """Write the 8-bit network: weights per channel and in 7 bits, activations per tensor, bytes in
    and out.

    Args:
        source: float network, see PaintGraph.
        output: where the 8-bit one goes; its inputs and output are codes.
        calibration: frames that give the ranges of the activations.
        held_out: other frames, on which both are compared.

    Returns:
        Lowest PSNR in dB of the 8-bit picture to the float one over ``held_out``.

    Raises:
        AssetError: it is below 40 dB.
    """
    feeds = [feed(placed) for placed in calibration]
    overrides = partial(_overrides, feeds=feeds)
    network = quantise_network(source, feeds, overrides, seven_bits=True)
    with tempfile.TemporaryDirectory() as folder:
        corrected = Path(folder) / source.name
        onnx.save(_corrected(onnx.load(str(source)), network, calibration), str(corrected))
        network = quantise_network(corrected, feeds, overrides, seven_bits=True)
    onnx.save(_on_bytes(network), str(output))
    exact, small = (
        ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        for path in (source, output)
    )
    lowest = np.inf
    for placed in held_out:
        codes = feed(placed)
        expected = to_codes(exact.run(None, codes)[0])
        found = small.run(None, {name: x.astype(np.uint8) for name, x in codes.items()})[0]
        pictures = [mix(x[0], placed) for x in (expected, found)]
        lowest = min(lowest, psnr(*pictures))
    if lowest < MIN_PSNR:
        raise AssetError(
            f"the 8-bit network is {lowest:.1f} dB from the float one, wanted {MIN_PSNR:g}",
            hint="calibrate on more pictures, or keep more layers in float",
        )
    return float(lowest)


def _corrected(
    exact: onnx.ModelProto, small: onnx.ModelProto, calibration: Sequence[Placed]
) -> onnx.ModelProto:
    """The float network, its last biases moved by the mean error of the 8-bit one.

    Rounded weights err alike at every pixel, which tints the picture: nothing else of the error is
    as large, and nothing is as easily undone. Pixels beside the person do not count.
    """
    sessions = [
        ort.InferenceSession(network.SerializeToString(), providers=["CPUExecutionProvider"])
        for network in (exact, small)
    ]
    errors = []
    for placed in calibration:
        wanted, found = (session.run(None, feed(placed))[0][0] for session in sessions)
        errors.append((wanted - found)[placed.reach[::2, ::2] > 0])
    last = [node for node in exact.graph.node if node.op_type == "Conv"][-1]
    bias = next(each for each in exact.graph.initializer if each.name == last.input[2])
    values = numpy_helper.to_array(bias) + np.concatenate(errors).mean(0)
    bias.CopyFrom(numpy_helper.from_array(values.astype(np.float32), bias.name))
    return exact


def _overrides(network: onnx.ModelProto, feeds: Sequence[Feed]) -> Overrides:
    """Scales that calibration must not choose: bytes stay bytes at the network's ends, and what
    is concatenated shares a scale."""
    codes = override(1.0, 0)
    overrides = dict.fromkeys(feeds[0], codes)
    overrides[network.graph.output[0].name] = override(1 / 127.5, 128)
    made_by = {name: node for node in network.graph.node for name in node.output}
    groups = concatenated(network)
    highest = largest(network, sorted({name for group in groups for name in group}), feeds)
    for group in groups:
        at_ends = any(made_by[name].op_type == "Transpose" for name in group)
        shared = codes if at_ends else override(max(highest[n] for n in group) / 255, 0)
        overrides |= dict.fromkeys(group, shared)
    for node in network.graph.node:
        if node.op_type == "Transpose":
            for a, b in ((node.input[0], node.output[0]), (node.output[0], node.input[0])):
                if a in overrides:
                    overrides[b] = overrides[a]
    return overrides


def _on_bytes(network: onnx.ModelProto) -> onnx.ModelProto:
    """The same network without the conversion from and to float at its ends."""
    graph = network.graph
    inputs = {each.name: each for each in graph.input}
    for node in list(graph.node):
        if node.op_type == "QuantizeLinear" and node.input[0] in inputs:
            inputs[node.input[0]].type.tensor_type.elem_type = onnx.TensorProto.UINT8
            for other in graph.node:
                for i, name in enumerate(other.input):
                    if name == node.output[0]:
                        other.input[i] = node.input[0]
            graph.node.remove(node)
    (output,) = graph.output
    last = next(node for node in graph.node if output.name in node.output)
    assert last.op_type == "DequantizeLinear", "the output is quantised"
    before = next(node for node in graph.node if last.input[0] in node.output)
    before.output[0] = output.name
    graph.node.remove(last)
    output.type.tensor_type.elem_type = onnx.TensorProto.UINT8
    return network
