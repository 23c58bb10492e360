"""Static 8-bit quantisation of a convolutional network: weights per channel, activations per
tensor, ranges from real inputs."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

Feed = dict[str, NDArray[np.float32]]
Override = dict[str, Any]
Overrides = dict[str, list[Override]]

QUANTISED = ("Conv", "Relu", "MaxPool", "Resize", "Concat", "Transpose")


class _Feeds(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, feeds: Sequence[Feed]) -> None:
        self._rest: Iterator[Feed] = iter(feeds)

    def get_next(self) -> Feed | None:
        return next(self._rest, None)


def quantise_network(
    source: Path,
    feeds: Sequence[Feed],
    overrides: Callable[[onnx.ModelProto], Overrides] | None = None,
    operators: Sequence[str] = QUANTISED,
    first: int = 0,
    *,
    seven_bits: bool = False,
) -> onnx.ModelProto:
    """The 8-bit network, still with float inputs and outputs.

    Args:
        source: float network.
        feeds: inputs that give the ranges of the activations.
        overrides: the network as it is quantised -> scales that calibration must not choose.
        operators: whose inputs and outputs are rounded.
        first: the first convolution of which that is true; those before it stay in float.
        seven_bits: of the weights. Processors without VNNI add products in 16 bits, which
            overflow with eight: the same network gives another picture there.
    """
    with tempfile.TemporaryDirectory() as folder:
        prepared, simulated = Path(folder) / "prepared.onnx", Path(folder) / "simulated.onnx"
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        network = onnx.load(str(prepared))
        convolutions = [node.name for node in network.graph.node if node.op_type == "Conv"]
        quantize_static(
            str(prepared),
            str(simulated),
            _Feeds(feeds),
            op_types_to_quantize=list(operators),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            reduce_range=seven_bits,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=convolutions[:first],
            extra_options={"TensorQuantOverrides": overrides(network) if overrides else {}},
        )
        return onnx.load(str(simulated))


def concatenated(network: onnx.ModelProto) -> list[list[str]]:
    """Tensors that share a scale, so that concatenating moves bytes and computes nothing."""
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
    return groups


def override(scale: float, zero_point: int) -> list[Override]:
    """A tensor's scale and zero point."""
    return [{"scale": np.array(scale, np.float32), "zero_point": np.array(zero_point, np.uint8)}]


def largest(
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


def psnr(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """In dB, of two RGBA pictures on black, so that colour where there is no head does not
    count."""
    shown = [x[..., :3].astype(np.float64) * x[..., 3:] / 255 for x in (a, b)]
    error = float(np.mean((shown[0] - shown[1]) ** 2))
    return float(10 * np.log10(255**2 / max(error, 1e-10)))
