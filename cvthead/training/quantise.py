"""Static 8-bit quantisation of the frame network, calibrated on real splats."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from cvthead.errors import AssetError
from cvthead.runtime.mix import mix
from cvthead.runtime.place import Placed
from cvthead.runtime.subpixels import unshuffled
from cvthead.training.onnx_export import to_codes

Feed = dict[str, NDArray[np.float32]]
Override = dict[str, Any]

MIN_PSNR = 40.0
QUANTISED = ("Conv", "Relu", "MaxPool", "Resize", "Concat", "Transpose")


class _Feeds(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, feeds: Sequence[Feed]) -> None:
        self._rest: Iterator[Feed] = iter(feeds)

    def get_next(self) -> Feed | None:
        return next(self._rest, None)


def feed(placed: Placed) -> Feed:
    """A placed frame as the float network reads it."""
    codes = {"splat": placed.codes, "portrait": unshuffled(placed.warped)}
    return {name: x[None].astype(np.float32) for name, x in codes.items()}


def quantise(
    source: Path, output: Path, calibration: Sequence[Placed], held_out: Sequence[Placed]
) -> float:
    """Write the 8-bit network: weights per channel, activations per tensor, bytes in and out.

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
    with tempfile.TemporaryDirectory() as folder:
        prepared, simulated = Path(folder) / "prepared.onnx", Path(folder) / "simulated.onnx"
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        quantize_static(
            str(prepared),
            str(simulated),
            _Feeds(feeds),
            op_types_to_quantize=list(QUANTISED),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            extra_options={"TensorQuantOverrides": _overrides(onnx.load(str(prepared)), feeds)},
        )
        onnx.save(_on_bytes(onnx.load(str(simulated))), str(output))
    exact, small = (
        ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        for path in (source, output)
    )
    lowest = np.inf
    for placed in held_out:
        codes = feed(placed)
        expected = to_codes(exact.run(None, codes)[0])
        found = small.run(None, {name: x.astype(np.uint8) for name, x in codes.items()})[0]
        pictures = [mix(x[0], placed.warped, placed.reach) for x in (expected, found)]
        lowest = min(lowest, _psnr(*pictures))
    if lowest < MIN_PSNR:
        raise AssetError(
            f"the 8-bit network is {lowest:.1f} dB from the float one, wanted {MIN_PSNR:g}",
            hint="calibrate on more pictures, or keep more layers in float",
        )
    return float(lowest)


def _overrides(network: onnx.ModelProto, feeds: Sequence[Feed]) -> dict[str, list[Override]]:
    """Scales that calibration must not choose: bytes stay bytes at the network's ends, and what
    is concatenated shares a scale, so that concatenating moves bytes and computes nothing."""
    codes = _override(1.0, 0)
    overrides = dict.fromkeys(feeds[0], codes)
    overrides[network.graph.output[0].name] = _override(1 / 127.5, 128)
    made_by = {name: node for node in network.graph.node for name in node.output}
    groups: list[list[str]] = []
    for node in network.graph.node:
        if node.op_type == "Concat":
            inputs = [made_by[name] for name in node.input if name in made_by]
            # An upsampled tensor takes its scale from what it is made of.
            groups.append(
                [i.input[0] if i.op_type == "Resize" else i.output[0] for i in inputs]
                + [i.output[0] for i in inputs]
                + list(node.output)
            )
    largest = _largest(network, sorted({name for group in groups for name in group}), feeds)
    for group in groups:
        at_ends = any(made_by[name].op_type == "Transpose" for name in group)
        shared = codes if at_ends else _override(max(largest[n] for n in group) / 255, 0)
        overrides |= dict.fromkeys(group, shared)
    for node in network.graph.node:
        if node.op_type == "Transpose":
            for a, b in ((node.input[0], node.output[0]), (node.output[0], node.input[0])):
                if a in overrides:
                    overrides[b] = overrides[a]
    return overrides


def _override(scale: float, zero_point: int) -> list[Override]:
    return [{"scale": np.array(scale, np.float32), "zero_point": np.array(zero_point, np.uint8)}]


def _largest(
    network: onnx.ModelProto, names: Sequence[str], feeds: Sequence[Feed]
) -> dict[str, float]:
    """Largest value of each tensor over the feeds; they follow a ReLU, so 0 is the smallest."""
    probe = onnx.ModelProto()
    probe.CopyFrom(network)
    known = {output.name for output in probe.graph.output}
    probe.graph.output.extend(onnx.ValueInfoProto(name=n) for n in names if n not in known)
    session = ort.InferenceSession(probe.SerializeToString(), providers=["CPUExecutionProvider"])
    found = [[float(x.max()) for x in session.run(list(names), each)] for each in feeds]
    return dict(zip(names, np.max(found, axis=0).tolist(), strict=True))


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


def _psnr(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Of the pictures on black, so that colour where there is no head does not count."""
    shown = [x[..., :3].astype(np.float64) * x[..., 3:] / 255 for x in (a, b)]
    error = float(np.mean((shown[0] - shown[1]) ** 2))
    return float(10 * np.log10(255**2 / max(error, 1e-10)))
