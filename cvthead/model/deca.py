"""DECA's coarse encoder: FLAME coefficients and camera of a face crop (Feng et al. 2021).

Attribute names are those of the released weights.
"""

from __future__ import annotations

from torch import Tensor, nn

from cvthead.model.resnet import resnet50
from cvthead.runtime.deca_codes import CODES


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
