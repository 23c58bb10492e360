"""The open preset's two networks as ONNX files, compared with torch after export."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from cvthead.camera import CROP_PIXELS
from cvthead.deformation import MAX_SHELL_POINTS
from cvthead.errors import AssetError
from cvthead.model.cvthead import CVTHead
from cvthead.model.light_unet import PORTRAIT_SIZE

OPSET = 18
MAX_BATCH = 64
HALVED_FROM = 1024  # values
# Largest difference to torch: descriptors in their own units, pictures in grey levels.
DESCRIBE_TOLERANCE = 2e-3
PAINT_TOLERANCE = 1.0


class DescribeGraph(nn.Module):
    """Source -> descriptors; see CVTHead.describe."""

    def __init__(self, model: CVTHead) -> None:
        super().__init__()
        self.model = model

    def forward(self, source: Tensor, points: Tensor, visible: Tensor, anchor: Tensor) -> Tensor:
        return self.model.describe(source, points, visible, anchor)


class PaintGraph(nn.Module):
    """Splat and warped portrait -> RGBA picture: the part of CVTHead.paint after both.

    The stem reads the portrait by a strided convolution, which is the same as unshuffling its
    pixels first but moves no memory.
    """

    scale: Tensor
    shift: Tensor

    def __init__(self, model: CVTHead) -> None:
        super().__init__()
        self.model = model
        stem, step = model.unet.stem[0], model.unet.unshuffle
        assert isinstance(stem, nn.Conv2d)
        assert stem.bias is not None, "batch norms are folded first"
        weight = stem.weight.detach()
        rest = stem.in_channels - PORTRAIT_SIZE * step**2
        self.on_splat = nn.Conv2d(rest, stem.out_channels, 1, bias=False)
        self.on_portrait = nn.Conv2d(PORTRAIT_SIZE, stem.out_channels, step, step)
        self.on_splat.weight.data = weight[:, :rest].clone()
        portrait = weight[:, rest:, 0, 0]
        self.on_portrait.weight.data = portrait.reshape(-1, PORTRAIT_SIZE, step, step).clone()
        assert self.on_portrait.bias is not None
        self.on_portrait.bias.data = stem.bias.detach().clone()
        self.register_buffer("scale", torch.tensor([2.0, 2, 2, 1]) / 255)
        self.register_buffer("shift", torch.tensor([1.0, 1, 1, 0]))

    def forward(self, splat: Tensor, warped: Tensor) -> Tensor:
        """(b, s, s, 1 + C + 1) and (b, 256, 256, 4) uint8 -> (b, 256, 256, 4) uint8."""
        portrait = (warped.float() * self.scale - self.shift).permute(0, 3, 1, 2)
        filled = self.model.filled(splat.permute(0, 3, 1, 2))
        x = torch.relu(self.on_splat(filled) + self.on_portrait(portrait))
        return to_pixels(*self.model.unet.after_stem(x, portrait))


def to_pixels(rgb: Tensor, logits: Tensor) -> Tensor:
    """RGB (b, 3, h, w) in [-1, 1] and mask logits -> (b, h, w, 4) uint8."""
    image = torch.cat([(rgb + 1) * 127.5, torch.sigmoid(logits) * 255], dim=1)
    return image.round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)


def folded(model: CVTHead) -> CVTHead:
    """A copy for inference whose batch norms are folded into the convolutions before them."""
    model = copy.deepcopy(model).eval()
    for module in list(model.modules()):
        if isinstance(module, nn.Sequential):
            for index, (conv, norm) in enumerate(pairwise(module)):
                if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                    module[index] = fuse_conv_bn_eval(conv, norm)
                    module[index + 1] = nn.Identity()
    return model


def export_describe(model: CVTHead, path: Path) -> None:
    """Write the source network; inputs source, points, visible, anchor of CVTHead.describe.

    Raises:
        AssetError: onnxruntime and torch differ.
    """
    generator = torch.Generator().manual_seed(0)
    points = len(model.mirror) + MAX_SHELL_POINTS
    inputs = {
        "source": torch.rand(1, 4, CROP_PIXELS, CROP_PIXELS, generator=generator) * 2 - 1,
        "points": torch.rand(1, points, 3, generator=generator) * 2 - 1,
        "visible": (torch.rand(1, points, generator=generator) > 0.5).float(),
        "anchor": torch.randint(0, 1000, (1, MAX_SHELL_POINTS), generator=generator),
    }
    _export(DescribeGraph(folded(model)), inputs, path)
    with torch.inference_mode():
        expected = DescribeGraph(model.eval())(*inputs.values())
    _halve(path)
    _check(path, inputs, expected, DESCRIBE_TOLERANCE)


def export_paint(model: CVTHead, path: Path) -> None:
    """Write the frame network of any batch size; inputs splat and warped of PaintGraph.

    Raises:
        AssetError: onnxruntime and torch differ.
    """
    generator = torch.Generator().manual_seed(0)
    size = CROP_PIXELS // model.config.unet_unshuffle
    splat = torch.randn(2, size, size, 2 + model.config.descriptor_size, generator=generator)
    shape = (2, CROP_PIXELS, CROP_PIXELS, PORTRAIT_SIZE)
    warped = torch.randint(0, 256, shape, generator=generator).to(torch.uint8)
    inputs = {"splat": splat * 0.3, "warped": warped}
    plain = PaintGraph(folded(model))
    batch = torch.export.Dim("batch", min=1, max=MAX_BATCH)
    _export(plain, inputs, path, {name: {0: batch} for name in inputs})
    with torch.inference_mode():
        portrait = (warped.float() * plain.scale - plain.shift).permute(0, 3, 1, 2)
        filled = model.filled(inputs["splat"].permute(0, 3, 1, 2))
        expected = to_pixels(*model.eval().unet(filled, portrait))
    _check(path, inputs, expected, PAINT_TOLERANCE)


def _export(
    graph: nn.Module,
    inputs: Mapping[str, Tensor],
    path: Path,
    dynamic: dict[str, Any] | None = None,
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            graph.eval(),
            tuple(inputs.values()),
            path,
            input_names=list(inputs),
            output_names=["out"],
            opset_version=OPSET,
            dynamic_shapes=dynamic,
            dynamo=True,
            external_data=False,
            verbose=False,
        )


def _halve(path: Path) -> None:
    """Store large tables in half precision; onnxruntime widens them once when it loads."""
    network = onnx.load(str(path))
    for table in list(network.graph.initializer):
        values = onnx.numpy_helper.to_array(table)
        if values.dtype == np.float32 and values.size > HALVED_FROM:
            name = f"{table.name}.half"
            network.graph.initializer.remove(table)
            network.graph.initializer.append(
                onnx.numpy_helper.from_array(values.astype(np.float16), name)
            )
            cast = onnx.helper.make_node("Cast", [name], [table.name], to=onnx.TensorProto.FLOAT)
            network.graph.node.insert(0, cast)
    onnx.save(network, str(path))


def _check(path: Path, inputs: Mapping[str, Tensor], expected: Tensor, tolerance: float) -> None:
    session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    feed = {name: value.numpy() for name, value in inputs.items()}
    found: NDArray[np.float32] = session.run(None, feed)[0]
    difference = float(np.abs(found.astype(np.float32) - expected.float().numpy()).max())
    if difference > tolerance:
        raise AssetError(
            f"{path.name} differs from torch by {difference:g}, allowed {tolerance:g}",
            hint="look for an operator that the exporter translates differently",
        )
