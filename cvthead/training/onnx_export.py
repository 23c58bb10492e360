"""The open preset's two networks as ONNX files, compared with torch after export."""

from __future__ import annotations

import copy
import itertools
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval

from cvthead.camera import CROP_PIXELS
from cvthead.deformation import MAX_SHELL_POINTS
from cvthead.model.cvthead import CVTHead
from cvthead.model.light_unet import PIXEL_SIZE, PORTRAIT_SIZE
from cvthead.runtime.fill import FILL_LEVELS, ZERO
from cvthead.runtime.mix import LOGIT_RANGE
from cvthead.runtime.place import CODE_STEPS, DEPTH_RANGE, code_size
from cvthead.training.onnx_files import check_graph, compare, export_graph

MAX_BATCH = 64
HALVED_FROM = 1024  # values
# Largest difference to torch: descriptors in codes, pictures in a share of black to white.
DESCRIBE_TOLERANCE = 2.0
PAINT_TOLERANCE = 2e-3


class DescribeGraph(nn.Module):
    """Source -> descriptor codes; see CVTHead.describe."""

    largest: Tensor

    def __init__(self, model: CVTHead, largest: Tensor) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("largest", largest)

    def forward(
        self, source: Tensor, points: Tensor, clear: Tensor, anchor: Tensor, hidden: Tensor
    ) -> Tensor:
        """(b, p, C) uint8, ``largest`` (C,) of either sign on CODE_STEPS codes."""
        descriptors = self.model.describe(source, points, clear, anchor, hidden) / self.largest
        steps = (descriptors * CODE_STEPS).round().clamp(-CODE_STEPS, CODE_STEPS)
        return (steps + ZERO).to(torch.uint8)


class PaintGraph(nn.Module):
    """Codes of a placed frame -> codes of the picture: CVTHead.paint after splat and fill.

    All inputs and outputs are 0..255, so that the 8-bit network reads and writes bytes. What the
    model does to them before its first convolution and after its last is folded into both, and
    the last one, which the model runs on pixels, runs on blocks of pixels here.
    """

    def __init__(self, model: CVTHead, largest: Tensor, feature_range: float) -> None:
        """Args:
        model: with folded batch norms.
        largest: (C,) see DescribeGraph.
        feature_range: of the last features; they become codes as well.
        """
        super().__init__()
        self.unet = copy.deepcopy(model.unet)
        self.stem = _stem_on_codes(model, largest)
        codes = 255 / feature_range
        for tensor in (self.unet.to_pixels.weight, self.unet.to_pixels.bias):
            assert tensor is not None
            tensor.data *= codes
        self.to_blocks = _last_on_codes(model, codes)

    def forward(self, splat: Tensor, portrait: Tensor) -> Tensor:
        """(b, s, s, 5 + C) and (b, s, s, 16) -> (b, s, s, 20): RGB and mask of each of a block's
        pixels, then their gates, all -1..1 (mask and gate as logits by LOGIT_RANGE)."""
        splat, portrait = splat.permute(0, 3, 1, 2), portrait.permute(0, 3, 1, 2)
        x = self.unet.after_stem(torch.relu(self.stem(torch.cat([splat, portrait], dim=1))))
        out: Tensor = self.to_blocks(torch.cat([x, portrait], dim=1))
        return out.permute(0, 2, 3, 1)


def _stem_on_codes(model: CVTHead, largest: Tensor) -> nn.Conv2d:
    """The first convolution, for codes of depth, descriptor, seen, coverage and portrait."""
    stem, block = model.unet.stem[0], model.unet.unshuffle**2
    assert isinstance(stem, nn.Conv2d)
    assert stem.bias is not None, "batch norms are folded first"
    weight, bias = stem.weight.detach().clone(), stem.bias.detach().clone()
    signed = torch.cat([torch.tensor([DEPTH_RANGE]), largest]) / CODE_STEPS
    unsigned = torch.full((1 + FILL_LEVELS,), 1 / 255)
    colours = weight[:, len(signed) + len(unsigned) :]
    # The model orders a block's values by channel, the codes are ordered by pixel.
    by_channel = colours.reshape(len(weight), PORTRAIT_SIZE, block)
    portrait = torch.tensor([2.0, 2, 2, 1])[:, None] / 255
    bias -= by_channel[:, :3].sum((1, 2)) + (weight[:, : len(signed), 0, 0] * signed * ZERO).sum(1)
    scaled = (by_channel * portrait).transpose(1, 2).reshape(colours.shape)
    inner = weight[:, : len(signed) + len(unsigned)] * torch.cat([signed, unsigned])[:, None, None]
    return _convolution(torch.cat([inner, scaled], dim=1), bias)


def _last_on_codes(model: CVTHead, feature_codes: float) -> nn.Conv2d:
    """The last convolution, moved from pixels to blocks of pixels."""
    last, step = model.unet.to_image, model.unet.unshuffle
    assert last.bias is not None
    weight = last.weight.detach().clone()
    bias = last.bias.detach().clone()
    weight[:, :PIXEL_SIZE] /= feature_codes
    weight[:, PIXEL_SIZE:] /= 255
    for tensor in (weight, bias):
        tensor[3:] /= LOGIT_RANGE
    bias -= 0.5 / 127.5  # a code is 127.5 (y + 1), the network's zero point is 128
    blocks = torch.zeros(step, step, len(weight), weight.shape[1], step, step, 3, 3)
    for row, column, down, right in itertools.product(range(step), range(step), range(3), range(3)):
        block_row, inner_row = divmod(row + down - 1, step)
        block_column, inner_column = divmod(column + right - 1, step)
        blocks[row, column, :, :, inner_row, inner_column, block_row + 1, block_column + 1] = (
            weight[:, :, down, right]
        )
    features = blocks[:, :, :, :PIXEL_SIZE].reshape(step, step, len(weight), -1, 3, 3)
    portrait = blocks[:, :, :, PIXEL_SIZE:].movedim(3, 5)
    portrait = portrait.reshape(step, step, len(weight), -1, 3, 3)
    both = torch.cat([features, portrait], dim=3)
    rgba = both[:, :, :4].reshape(-1, *both.shape[3:])
    gate = both[:, :, 4].reshape(-1, *both.shape[3:])
    bias = torch.cat([bias[:4].repeat(step**2), bias[4:].repeat(step**2)])
    return _convolution(torch.cat([rgba, gate]), bias)


def _convolution(weight: Tensor, bias: Tensor) -> nn.Conv2d:
    size_out, size_in, kernel, _ = weight.shape
    out = nn.Conv2d(size_in, size_out, kernel, padding=kernel // 2)
    out.weight.data, out.bias.data = weight, bias  # type: ignore[union-attr]
    return out


def to_codes(out: NDArray[np.float32]) -> NDArray[np.uint8]:
    """What the 8-bit network gives for PaintGraph's output."""
    return np.asarray(np.rint(out * 127.5 + 128).clip(0, 255), np.uint8)


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


def export_describe(model: CVTHead, largest: Tensor, path: Path) -> None:
    """Write the source network; inputs as CVTHead.describe has them.

    Raises:
        AssetError: onnxruntime and torch differ.
    """
    generator = torch.Generator().manual_seed(0)
    points = len(model.mirror) + MAX_SHELL_POINTS
    inputs = {
        "source": torch.rand(1, 4, CROP_PIXELS, CROP_PIXELS, generator=generator) * 2 - 1,
        "points": torch.rand(1, points, 3, generator=generator) * 2 - 1,
        "clear": (torch.rand(1, points, generator=generator) > 0.5).float(),
        "anchor": torch.randint(0, 1000, (1, MAX_SHELL_POINTS), generator=generator),
        "hidden": torch.rand(1, points, 3, generator=generator) * 2 - 1,
    }
    export_graph(DescribeGraph(folded(model), largest), inputs, path)
    with torch.inference_mode():
        expected = DescribeGraph(model.eval(), largest)(*inputs.values())
    _halve(path)
    check_graph(path, inputs, [expected], [DESCRIBE_TOLERANCE])


def export_paint(model: CVTHead, largest: Tensor, feature_range: float, path: Path) -> None:
    """Write the frame network of any batch size, in float; inputs splat and portrait of PaintGraph.

    Raises:
        AssetError: it differs from the model in torch.
    """
    generator = torch.Generator().manual_seed(0)
    size = CROP_PIXELS // model.config.unet_unshuffle
    channels = code_size(model.config.descriptor_size)
    block = PORTRAIT_SIZE * model.config.unet_unshuffle**2
    inputs = {
        name: torch.randint(0, 256, (2, size, size, count), generator=generator).float()
        for name, count in (("splat", channels), ("portrait", block))
    }
    graph = PaintGraph(folded(model), largest, feature_range)
    batch = torch.export.Dim("batch", min=1, max=MAX_BATCH)
    export_graph(graph, inputs, path, dynamic={name: {0: batch} for name in inputs})
    with torch.inference_mode():
        found = graph(*inputs.values())
        expected = _reference(model.eval(), largest, **inputs)
    hint = "its folded first and last convolutions no longer fit the model"
    compare("the frame graph", found.numpy(), expected, PAINT_TOLERANCE, hint)
    check_graph(path, inputs, [found], [PAINT_TOLERANCE])


def _reference(model: CVTHead, largest: Tensor, splat: Tensor, portrait: Tensor) -> Tensor:
    """PaintGraph by the model's own layers."""
    step, inner = model.unet.unshuffle, splat.permute(0, 3, 1, 2)
    signed = torch.cat([torch.tensor([DEPTH_RANGE]), largest])[:, None, None]
    descriptors = (inner[:, : len(signed)] - ZERO) / CODE_STEPS * signed
    filled = torch.cat([descriptors, inner[:, len(signed) :] / 255], dim=1)
    size = portrait.shape[1]
    blocks = portrait.reshape(-1, size, size, step, step, PORTRAIT_SIZE) / 255
    warped = blocks.permute(0, 5, 1, 3, 2, 4).reshape(-1, PORTRAIT_SIZE, size * step, size * step)
    network = torch.cat([warped[:, :3] * 2 - 1, warped[:, 3:]], dim=1)
    x = model.unet.stem(torch.cat([filled, F.pixel_unshuffle(network, step)], dim=1))
    x = F.pixel_shuffle(model.unet.after_stem(x), step)
    out = model.unet.to_image(torch.cat([x, warped], dim=1))
    out[:, 3:] /= LOGIT_RANGE
    out = out.reshape(-1, 5, size, step, size, step).permute(0, 2, 4, 3, 5, 1) - 0.5 / 127.5
    rgba, gate = (x.reshape(-1, size, size, n) for x, n in ((out[..., :4], 16), (out[..., 4:], 4)))
    return torch.cat([rgba, gate], dim=-1)


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
