"""Seeded stand-ins for the networks inside the loss that users bring."""

from __future__ import annotations

from pathlib import Path

import torch

from cvthead.training.identity import VGGFace2ResNet50
from cvthead.training.vgg import BLOCKS, vgg_features


def made_vgg(path: Path, name: str) -> Path:
    """Seeded weights under torchvision's key names, classifier included."""
    torch.manual_seed(0)
    features = vgg_features(BLOCKS[name]).state_dict()
    state = {f"features.{key}": value for key, value in features.items()}
    torch.save(state | {"classifier.0.weight": torch.zeros(1)}, path)
    return path


def made_identity(path: Path) -> Path:
    torch.manual_seed(1)
    state = VGGFace2ResNet50().state_dict()
    torch.save(state | {"fc.weight": torch.zeros(8631, 2048), "fc.bias": torch.zeros(8631)}, path)
    return path
