"""The imported weights become the ONNX files that serve them.

Normalisations that do not depend on the picture are folded into the convolutions: batch norm of
the U-Net, weight standardisation of the image encoder. Every file is compared with PyTorch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval

from cvthead.camera import CROP_PIXELS
from cvthead.model.hair import LinearDeformation
from cvthead.model.paper import PaperCVTHead
from cvthead.model.paper_pixel_aligned import PixelAlignedCVTHead
from cvthead.model.rome_encoder import StandardisedConv2d
from cvthead.model.unet import ConvNorm, UNet
from cvthead.official.crop import DECA_PIXELS
from cvthead.official.manifest import (
    DECA_ONNX,
    DESCRIBE_ONNX,
    HAIR_ONNX,
    PARSING_ONNX,
    UNET_ONNX,
)
from cvthead.official.torch_networks import TorchNetworks
from cvthead.training.onnx_files import check_graph, export_graph

TOLERANCE = 1e-3  # of an output's standard deviation
SMALLEST = 1e-6  # difference that is let pass where an output is constant
# onnxruntime's 8-bit convolution is slow over channels that are no multiple of this.
CHANNEL_STEP = 4


class HairGraph(nn.Module):
    """(b, 3, 256, 256) RGB in [-1, 1] -> (b, 60) coefficients and (b, 5023, 3) offsets."""

    def __init__(self, hair: LinearDeformation) -> None:
        super().__init__()
        self.hair = hair

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        coefficients = self.hair.hair_model.classify(image)
        return coefficients, self.hair.offsets(coefficients)


class DescribeGraph(nn.Module):
    """PaperCVTHead.describe, or that of the ablation."""

    def __init__(self, network: PaperCVTHead | PixelAlignedCVTHead) -> None:
        super().__init__()
        self.network = network

    def forward(self, source: Tensor, points: Tensor) -> Tensor:
        return self.network.describe(source, points)


class OnePassGroupNorm(nn.Module):
    """Group norm as onnxruntime runs it fastest: two sums over the picture, then a batch norm by
    what they give. Its own group norm reads and writes the picture four times as often."""

    def __init__(self, norm: nn.GroupNorm) -> None:
        super().__init__()
        self.norm = norm

    def forward(self, x: Tensor) -> Tensor:
        """(1, c, h, w) -> the same."""
        norm, channels = self.norm, x.shape[1]
        rows = x.reshape(norm.num_groups, -1)
        mean = rows.mean(dim=1)
        variance = torch.linalg.vector_norm(rows, dim=1).square() / rows.shape[1] - mean.square()
        means, variances = (
            each[:, None].expand(-1, channels // norm.num_groups).reshape(channels)
            for each in (mean, variance.clamp(min=0))
        )
        return F.batch_norm(x, means, variances, norm.weight, norm.bias, eps=norm.eps)


class UNetGraph(nn.Module):
    """(b, h, w, channels) splat -> (b, h, w, 4), RGB and mask before tanh and sigmoid.

    Channels last, as the splat gathers them. The last convolution, of one pixel, is a linear
    layer, so that the 8-bit network has its output in float without reordering its input.
    """

    def __init__(self, unet: UNet) -> None:
        """Takes the U-Net over: batch norms are folded, its input gets CHANNEL_STEP's multiple of
        channels, of which the last count for nothing."""
        super().__init__()
        last = unet.to_image
        self.to_raw = nn.Linear(last.in_channels, last.out_channels)
        self.to_raw.weight = nn.Parameter(last.weight[:, :, 0, 0])
        self.to_raw.bias = last.bias  # type: ignore[assignment]
        unet.to_image = nn.Identity()  # type: ignore[assignment]
        _fold(unet)
        _pad(unet)
        self.unet = unet

    def forward(self, splat: Tensor) -> Tensor:
        features: Tensor = self.unet(splat.permute(0, 3, 1, 2))
        raw: Tensor = self.to_raw(features.permute(0, 2, 3, 1))
        return raw


def export_networks(folder: Path) -> None:
    """Write the float32 networks beside the safetensors files of ``folder``.

    Raises:
        AssetError: a file differs from PyTorch.
    """
    networks = TorchNetworks.load(folder)
    picture = _noise(1, 3, CROP_PIXELS, CROP_PIXELS)
    _export(folder / PARSING_ONNX, networks.parsing, {"image": picture}, ["logits"])
    outputs = ["coefficients", "offsets"]
    _export(folder / HAIR_ONNX, HairGraph(networks.hair), {"image": picture}, outputs)
    face = _noise(1, 3, DECA_PIXELS, DECA_PIXELS) / 2 + 0.5
    _export(folder / DECA_ONNX, networks.deca, {"face": face}, ["codes"])
    export_network(folder, networks)


def export_network(folder: Path, networks: TorchNetworks) -> None:
    """Of :func:`export_networks` the two that are CVTHead's own.

    Args:
        folder: of the files.
        networks: taken over.

    Raises:
        AssetError: as :func:`export_networks`.
    """
    network, vertices = networks.network, len(networks.hair.deform_mean)
    picture = _noise(1, 3, CROP_PIXELS, CROP_PIXELS)
    mask = (_noise(1, 1, CROP_PIXELS, CROP_PIXELS) > 0).float()
    inputs = {"source": torch.cat([picture, mask], dim=1), "points": _noise(1, vertices, 3)}
    with torch.inference_mode():
        expected = DescribeGraph(network)(**inputs)
    if isinstance(network, PaperCVTHead):
        _prepare(network.encoder)
    _export(folder / DESCRIBE_ONNX, DescribeGraph(network), inputs, ["descriptors"], [expected])

    channels = 1 + network.config.descriptor_size
    splat = _noise(1, CROP_PIXELS, CROP_PIXELS, channels)
    with torch.inference_mode():
        expected = network.unet(splat.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    inputs = {"splat": F.pad(splat, (0, -channels % CHANNEL_STEP))}
    _export(folder / UNET_ONNX, UNetGraph(network.unet), inputs, ["raw"], [expected])


def _noise(*shape: int) -> Tensor:
    """The same in every call, in -1..1."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(0)) * 2 - 1


def _export(
    path: Path,
    graph: nn.Module,
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
    expected: Sequence[Tensor] | None = None,
) -> None:
    """Write and check a graph; what it should give is what it gives, unless said otherwise."""
    if expected is None:
        with torch.inference_mode():
            found = graph(*inputs.values())
        expected = [found] if isinstance(found, Tensor) else found
    tolerances = [TOLERANCE * float(each.std()) + SMALLEST for each in expected]
    export_graph(graph, inputs, path, outputs=outputs)
    check_graph(path, inputs, expected, tolerances)


def _prepare(encoder: nn.Module) -> None:
    """Replace filters by the standardised ones, once for all, and group norms by faster ones."""
    for parent in list(encoder.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, nn.GroupNorm):
                setattr(parent, name, OnePassGroupNorm(child))
            elif isinstance(child, StandardisedConv2d):
                plain = nn.Conv2d(
                    child.in_channels,
                    child.out_channels,
                    child.kernel_size,  # type: ignore[arg-type]
                    padding=child.padding,  # type: ignore[arg-type]
                    bias=False,
                )
                plain.weight = nn.Parameter(child.standardised(), requires_grad=False)
                setattr(parent, name, plain)


def _fold(unet: UNet) -> None:
    """Fold the batch norms into the convolutions before them."""
    for module in unet.modules():
        if isinstance(module, ConvNorm):
            assert isinstance(module.norm, nn.BatchNorm2d), "folded once"
            module.conv = fuse_conv_bn_eval(module.conv, module.norm)
            module.norm = nn.Identity()  # type: ignore[assignment]


def _pad(unet: UNet) -> None:
    """Let the first convolution read a multiple of CHANNEL_STEP channels."""
    first = unet.get_submodule("downs.0.0.conv")
    assert isinstance(first, nn.Conv2d)
    count = -first.in_channels % CHANNEL_STEP
    first.weight = nn.Parameter(F.pad(first.weight, (0, 0, 0, 0, 0, count)), requires_grad=False)
    first.in_channels += count
