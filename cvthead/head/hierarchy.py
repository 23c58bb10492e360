"""Three resolutions of the head mesh for the spiral upsampler (paper section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvthead.errors import AssetError
from cvthead.head.model import read_arrays

Indices = NDArray[np.int32]
Array = NDArray[np.float32]

HIERARCHY_ASSET = "open_hierarchy.npz"
SPIRAL_LENGTH = 9


@dataclass(frozen=True, eq=False)
class MeshHierarchy:
    """Vertex selections down and weighted sums up between level 0 (full), 1 (a quarter) and 2.

    Attributes:
        down: down[k] (n_k+1,) int32: which vertices of level k make up level k + 1.
        up: up[k] = indices (n_k, 3) int32 into level k + 1 and weights (n_k, 3): features of
            level k from those of level k + 1. Weights are used as they are stored.
        spirals: spirals[k] (n_k, 9) int32 for levels 0 and 1: a vertex, then its neighbours
            in ring order, turning clockwise seen from outside.
    """

    down: tuple[Indices, ...]
    up: tuple[tuple[Indices, Array], ...]
    spirals: tuple[Indices, ...]

    def __post_init__(self) -> None:
        counts = self.counts
        fits = len(self.up) == len(self.down) == len(self.spirals) and all(
            indices.shape == weights.shape == (fine, 3)
            and indices.max() < coarse
            and down.max() < fine
            and spiral.shape == (fine, SPIRAL_LENGTH)
            and spiral.max() < fine
            for (fine, coarse), down, (indices, weights), spiral in zip(
                pairwise(counts), self.down, self.up, self.spirals, strict=True
            )
        )
        if not fits:
            raise AssetError("mesh hierarchy: levels do not fit", hint="build the hierarchy again")

    @property
    def counts(self) -> tuple[int, ...]:
        """Vertices of every level, finest first."""
        return (*(len(spiral) for spiral in self.spirals), len(self.down[-1]))

    @property
    def coarse(self) -> Indices:
        """(n,) vertices of the full mesh that make up the coarsest level."""
        selection = self.down[0]
        for down in self.down[1:]:
            selection = selection[down]
        return selection

    @classmethod
    def load(cls, path: Path | None = None) -> MeshHierarchy:
        """The packaged hierarchy of the open head, or another file of the same format.

        Raises:
            AssetError: missing, unreadable or inconsistent.
        """
        arrays = read_arrays(path, HIERARCHY_ASSET)
        try:
            down = tuple(arrays[f"down_{k}"].astype(np.int32) for k in range(2))
            up = tuple(
                (
                    arrays[f"up_indices_{k}"].astype(np.int32),
                    arrays[f"up_weights_{k}"].astype(np.float32),
                )
                for k in range(2)
            )
            spirals = tuple(arrays[f"spirals_{k}"].astype(np.int32) for k in range(2))
        except KeyError as error:
            raise AssetError(
                f"mesh hierarchy: {error} is missing", hint="build the hierarchy again"
            ) from error
        return cls(down, up, spirals)
