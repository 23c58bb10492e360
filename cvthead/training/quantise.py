"""Static 8-bit quantisation of the frame network, calibrated on real splats."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from cvthead.errors import AssetError

Feed = dict[str, NDArray[np.generic]]

MIN_PSNR = 40.0
QUANTISED = ("Conv", "Relu", "MaxPool", "Resize", "Concat")


class _Feeds(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, feeds: Sequence[Feed]) -> None:
        self._rest: Iterator[Feed] = iter(feeds)

    def get_next(self) -> Feed | None:
        return next(self._rest, None)


def quantise(
    source: Path, output: Path, calibration: Sequence[Feed], held_out: Sequence[Feed]
) -> float:
    """Write the 8-bit network: weights per channel, activations per tensor.

    The stem stays float, since its inputs differ in scale by channel, and so does the last
    convolution, which makes the picture.

    Args:
        source: float network.
        output: where the 8-bit one goes.
        calibration: inputs that give the ranges of the activations.
        held_out: other inputs, on which both are compared.

    Returns:
        Lowest PSNR in dB of the 8-bit picture to the float one over ``held_out``.

    Raises:
        AssetError: it is below 40 dB.
    """
    with tempfile.TemporaryDirectory() as folder:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        quantize_static(
            str(prepared),
            str(output),
            _Feeds(calibration),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_quantize=_inner_nodes(onnx.load(str(prepared)).graph),
        )
    exact, small = (
        ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        for path in (source, output)
    )
    lowest = min(_psnr(exact.run(None, feed)[0], small.run(None, feed)[0]) for feed in held_out)
    if lowest < MIN_PSNR:
        raise AssetError(
            f"the 8-bit network is {lowest:.1f} dB from the float one, wanted {MIN_PSNR:g}",
            hint="calibrate on more pictures, or keep more layers in float",
        )
    return lowest


def _inner_nodes(graph: onnx.GraphProto) -> list[str]:
    """Nodes between the stem and the last convolution."""
    convolutions = [i for i, node in enumerate(graph.node) if node.op_type == "Conv"]
    shuffle = next(i for i, node in enumerate(graph.node) if node.op_type == "DepthToSpace")
    return [
        node.name for node in graph.node[convolutions[2] : shuffle] if node.op_type in QUANTISED
    ]


def _psnr(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Of the pictures on black, so that colour where there is no head does not count."""
    shown = [x[..., :3].astype(np.float64) * x[..., 3:] / 255 for x in (a, b)]
    error = float(np.mean((shown[0] - shown[1]) ** 2))
    return float(10 * np.log10(255**2 / max(error, 1e-10)))
