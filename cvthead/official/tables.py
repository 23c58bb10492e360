"""What training the official network takes from an import besides its weights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from cvthead.coefficients import Array
from cvthead.errors import AssetError
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel
from cvthead.official.flame import Flame
from cvthead.official.manifest import FLAME, HAIR, HINT, MESH, Manifest


@dataclass(frozen=True, eq=False)
class OfficialTables:
    """Fixed tables. Immutable.

    Attributes:
        head: FLAME.
        deform_mean, deform_basis: (5023, 3) and (5023, 3, 60) metres, of hair and shoulders.
        hierarchy: of the vertex upsampler.
        fingerprint: see Manifest.tables_fingerprint.
    """

    head: HeadModel
    deform_mean: Array
    deform_basis: Array
    hierarchy: MeshHierarchy
    fingerprint: str

    @classmethod
    def load(cls, folder: Path) -> OfficialTables:
        """From an import.

        Raises:
            AssetError: nothing was imported there, or it is damaged.
        """
        manifest = Manifest.load(folder)
        try:
            flame, hair, mesh = (load_file(manifest.checked(n)) for n in (FLAME, HAIR, MESH))
            head = Flame(**flame).head()
            return cls(
                head,
                hair["deform_mean"],
                hair["deform_basis"],
                stored_hierarchy(mesh),
                manifest.tables_fingerprint,
            )
        except (SafetensorError, TypeError, KeyError) as error:
            raise AssetError(f"{folder} does not fit this version: {error}", hint=HINT) from error

    def offsets(self, hair: Array) -> Array:
        """(60,) coefficients -> (5023, 3) offsets in posed space, metres (paper section 3.2)."""
        return np.asarray(self.deform_basis @ hair + self.deform_mean, np.float32)


def stored_hierarchy(arrays: dict[str, NDArray[np.generic]]) -> MeshHierarchy:
    """The mesh hierarchy of an import's file MESH."""
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
