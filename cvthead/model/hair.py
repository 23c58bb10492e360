"""Hair and shoulders as one linear deformation of the head (ROME; paper section 3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cvthead.model.resnet import resnet50

DEFORMATION_SIZE = 60


class LinearDeformation(nn.Module):
    """Vertex offsets from a portrait.

    Args:
        vertices: of the head model.
    """

    deform_mean: Tensor  # (n, 3), metres
    deform_basis: Tensor  # (n, 3, 60), metres

    def __init__(self, vertices: int) -> None:
        super().__init__()
        self.hair_model = resnet50(DEFORMATION_SIZE)
        self.register_buffer("deform_mean", torch.zeros(vertices, 3))
        self.register_buffer("deform_basis", torch.zeros(vertices, 3, DEFORMATION_SIZE))

    def forward(self, image: Tensor) -> Tensor:
        """(b, 3, h, w) RGB in [-1, 1] -> (b, n, 3) offsets in posed space, metres.

        ROME's own code feeds [0, 1]; CVTHead was trained on what [-1, 1] gives.
        """
        return self.offsets(self.hair_model.classify(image))

    def offsets(self, coefficients: Tensor) -> Tensor:
        """(b, 60) -> (b, n, 3)."""
        return torch.einsum("ncd,bd->bnc", self.deform_basis, coefficients) + self.deform_mean
