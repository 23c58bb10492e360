"""The imported networks in PyTorch: what the ONNX files are made from and measured against."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
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
from cvthead.official.manifest import DECA, HAIR, HINT, MESH, NETWORK, PARSING


@dataclass(frozen=True, eq=False)
class TorchNetworks:
    """Every network, in single precision and evaluation mode."""

    network: PaperCVTHead
    parsing: FaceParsing
    hair: LinearDeformation
    deca: DecaEncoder

    @classmethod
    def load(cls, folder: Path) -> TorchNetworks:
        """Load the safetensors files of an import.

        Raises:
            AssetError: a file does not fit.
        """
        try:
            hierarchy = _hierarchy(load_arrays(folder / MESH))
            network = PaperCVTHead(hierarchy)
            parsing = FaceParsing()
            hair = LinearDeformation(hierarchy.spirals[0].shape[0])
            deca = DecaEncoder()
            _fill(network, folder / NETWORK)
            _fill(parsing, folder / PARSING)
            _fill(hair, folder / HAIR)
            _fill(deca, folder / DECA)
        except (SafetensorError, OSError, RuntimeError, TypeError, KeyError) as error:
            raise AssetError(
                f"{folder} does not fit this version: {str(error).splitlines()[0]}", hint=HINT
            ) from error
        return cls(network, parsing, hair, deca)


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
