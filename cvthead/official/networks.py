"""The imported networks, loaded for inference."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file as load_arrays
from safetensors.torch import load_file
from torch import Tensor, nn

from cvthead.errors import AssetError
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.model.bisenet import FaceParsing
from cvthead.model.deca import DecaEncoder
from cvthead.model.hair import LinearDeformation
from cvthead.model.paper import PaperCVTHead
from cvthead.official.flame import Flame
from cvthead.official.manifest import (
    DECA,
    FLAME,
    HAIR,
    HINT,
    MESH,
    NETWORK,
    PARSING,
    Manifest,
)


@dataclass(frozen=True, eq=False)
class OfficialNetworks:
    """Everything with weights, in single precision and evaluation mode."""

    manifest: Manifest
    flame: Flame
    network: PaperCVTHead
    parsing: FaceParsing
    hair: LinearDeformation
    deca: DecaEncoder

    @classmethod
    def load(cls, folder: Path) -> OfficialNetworks:
        """Load an imported model.

        Raises:
            AssetError: nothing was imported there, or a file is missing, altered or does not fit.
        """
        manifest = Manifest.load(folder)
        try:
            tables = Flame(**load_arrays(manifest.checked(FLAME)))
            hierarchy = _hierarchy(load_arrays(manifest.checked(MESH)))
            network = PaperCVTHead(hierarchy)
            parsing = FaceParsing()
            hair = LinearDeformation(len(tables.template))
            deca = DecaEncoder()
            _fill(network, manifest.checked(NETWORK))
            _fill(parsing, manifest.checked(PARSING))
            _fill(hair, manifest.checked(HAIR))
            _fill(deca, manifest.checked(DECA))
        except (SafetensorError, RuntimeError, TypeError, KeyError) as error:
            raise AssetError(
                f"{folder} does not fit this version: {str(error).splitlines()[0]}", hint=HINT
            ) from error
        return cls(manifest, tables, network, parsing, hair, deca)


def _fill(module: nn.Module, path: Path) -> None:
    state: dict[str, Tensor] = load_file(path)
    # Takes the file's memory over instead of copying it.
    module.load_state_dict(state, assign=True)
    module.eval().requires_grad_(False)


def _hierarchy(arrays: dict[str, NDArray[np.generic]]) -> MeshHierarchy:
    levels = range(2)
    return MeshHierarchy(
        tuple(arrays[f"down_{k}"].astype(np.int32) for k in levels),
        tuple(
            (
                arrays[f"up_indices_{k}"].astype(np.int32),
                arrays[f"up_weights_{k}"].astype(np.float32),
            )
            for k in levels
        ),
        tuple(arrays[f"spirals_{k}"].astype(np.int32) for k in levels),
    )


def picture_tensor(picture: NDArray[np.uint8]) -> Tensor:
    """(h, w, 3) uint8 RGB -> (1, 3, h, w) in [-1, 1], as the released code normalises."""
    image = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None]
    return (image / 255 - 0.5) / 0.5
