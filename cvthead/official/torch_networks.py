"""The imported networks in PyTorch: what the ONNX files are made from and measured against."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file as load_arrays
from safetensors.torch import load_file
from torch import Tensor, nn

from cvthead.errors import AssetError
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.model.bisenet import FaceParsing
from cvthead.model.deca import DecaEncoder
from cvthead.model.hair import LinearDeformation
from cvthead.model.paper import PaperCVTHead
from cvthead.model.paper_pixel_aligned import PixelAlignedCVTHead
from cvthead.official.manifest import DECA, HAIR, HINT, MESH, NETWORK, PARSING
from cvthead.official.tables import stored_hierarchy


@dataclass(frozen=True, eq=False)
class TorchNetworks:
    """Every network, in single precision and evaluation mode.

    ``network`` is the released one, or one that was retrained with pixel-aligned features.
    """

    network: PaperCVTHead | PixelAlignedCVTHead
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
            hierarchy = stored_hierarchy(load_arrays(folder / MESH))
            network = _network(folder / NETWORK, hierarchy)
            parsing = FaceParsing()
            hair = LinearDeformation(hierarchy.spirals[0].shape[0])
            deca = DecaEncoder()
            _fill(parsing, folder / PARSING)
            _fill(hair, folder / HAIR)
            _fill(deca, folder / DECA)
        except (SafetensorError, OSError, RuntimeError, TypeError, KeyError) as error:
            raise AssetError(
                f"{folder} does not fit this version: {str(error).splitlines()[0]}", hint=HINT
            ) from error
        return cls(network, parsing, hair, deca)


def _network(path: Path, hierarchy: MeshHierarchy) -> PaperCVTHead | PixelAlignedCVTHead:
    with safe_open(str(path), framework="np") as file:
        aligned = any(name.startswith("extractor.") for name in file.keys())  # noqa: SIM118
    network = PixelAlignedCVTHead() if aligned else PaperCVTHead(hierarchy)
    _fill(network, path)
    return network


def _fill(module: nn.Module, path: Path) -> None:
    state: dict[str, Tensor] = load_file(path)
    # Takes the file's memory over instead of copying it.
    module.load_state_dict(state, assign=True)
    module.eval().requires_grad_(False)
