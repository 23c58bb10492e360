"""DECA's coarse encoder: FLAME coefficients and camera of a face crop (Feng et al. 2021).

Attribute names are those of the released weights.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cvthead.model.resnet import resnet50

# Names and lengths of the codes in the order of the network's output. ``tex`` (texture) and
# ``light`` are not used by CVTHead. ``pose`` is the axis-angle of the global and the jaw joint.
CODES = {"shape": 100, "tex": 50, "exp": 50, "pose": 6, "cam": 3, "light": 27}


class DecaEncoder(nn.Module):
    """(b, 3, 224, 224) RGB in [0, 1] -> (b, 236) codes."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = resnet50()
        self.layers = nn.Sequential(
            nn.Linear(2048, 1024), nn.ReLU(), nn.Linear(1024, sum(CODES.values()))
        )

    def forward(self, crop: Tensor) -> Tensor:
        codes: Tensor = self.layers(self.encoder.pooled(crop))
        return codes


def split_codes(codes: Tensor) -> dict[str, Tensor]:
    """(..., 236) -> the CODES by name, (..., length) each."""
    parts = torch.split(codes, list(CODES.values()), dim=-1)
    return dict(zip(CODES, parts, strict=True))
