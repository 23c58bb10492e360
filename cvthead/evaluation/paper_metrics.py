"""FID, CSIM, IQA and FPS of cross-identity reenactment, as the paper's table 2 has them.

The networks behind them are the user's to bring. A figure without its network is absent; nothing
else is put in its place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cvthead.errors import AssetError
from cvthead.evaluation.identity import Embed, onnx_embedder
from cvthead.evaluation.picture_networks import PictureNetwork, as_batch
from cvthead.evaluation.shots import Image
from cvthead.evaluation.speed import PUBLISHED_FPS
from cvthead.evaluation.table import Table

COLUMNS = {"FID ↓": ".2f", "CSIM ↑": ".3f", "IQA ↑": ".2f", "FPS ↑": ".1f"}
# The paper's table 2.
PUBLISHED: dict[str, tuple[float | None, ...]] = {
    "FOMM, paper, VoxCeleb1": (39.69, 0.592, 37.00, 64.3),
    "Bi-Layer, paper, VoxCeleb1": (43.8, 0.697, 41.4, 20.1),
    "ROME, paper, VoxCeleb1": (29.23, 0.717, 39.11, 12.9),
    "CVTHead, paper, VoxCeleb1": (25.78, 0.675, 42.26, PUBLISHED_FPS),
    "FOMM, paper, VoxCeleb2": (61.28, 0.624, 36.20, 64.3),
    "ROME, paper, VoxCeleb2": (53.52, 0.729, 37.34, 12.9),
    "CVTHead, paper, VoxCeleb2": (48.48, 0.712, 40.27, PUBLISHED_FPS),
}


@dataclass(frozen=True, eq=False)
class UserNetworks:
    """What the user brought; None where nothing.

    Attributes:
        lpips: takes two pictures (256 x 256), returns their distance.
        fid: takes a picture (256 x 256), returns features.
        csim: embeds a face.
        iqa: takes a picture (256 x 256), returns its quality.
    """

    lpips: PictureNetwork | None
    fid: PictureNetwork | None
    csim: Embed | None
    iqa: PictureNetwork | None

    @classmethod
    def load(
        cls,
        *,
        lpips: Path | None = None,
        fid: Path | None = None,
        csim: Path | None = None,
        iqa: Path | None = None,
    ) -> UserNetworks:
        """Open the files that are given.

        Raises:
            InputError: as PictureNetwork.load.
            AssetError: FID was asked for and torchmetrics is not installed.
        """
        if fid:
            frechet_class()
        return cls(
            PictureNetwork.load(lpips, inputs=2) if lpips else None,
            PictureNetwork.load(fid) if fid else None,
            onnx_embedder(csim) if csim else None,
            PictureNetwork.load(iqa) if iqa else None,
        )


class _Features(nn.Module):
    """A PictureNetwork as torchmetrics takes it."""

    def __init__(self, network: PictureNetwork, size: int) -> None:
        super().__init__()
        self.network = network
        self.num_features = size

    def forward(self, pictures: Tensor) -> Tensor:
        return torch.from_numpy(self.network(pictures.numpy()))


def frechet_class() -> Any:
    """torchmetrics' FrechetInceptionDistance.

    Raises:
        AssetError: torchmetrics is not installed.
    """
    try:
        from torchmetrics.image.fid import FrechetInceptionDistance
    except ImportError as error:
        raise AssetError(
            f"FID needs {error.name}", hint='install with pip install "cvthead[evaluate]"'
        ) from error
    return FrechetInceptionDistance


def frechet_distance(
    network: PictureNetwork, real: Sequence[Image], made: Sequence[Image]
) -> float:
    """FID (Heusel et al., 2017) between two sets of (H, W, 3) pictures, two or more each.

    Raises:
        AssetError: torchmetrics is not installed.
        InputError: the network does not take the pictures.
    """
    size = network(as_batch(real[0][None])).shape[1]
    distance = frechet_class()(feature=_Features(network, size))
    for pictures, is_real in ((real, True), (made, False)):
        for picture in pictures:
            distance.update(torch.from_numpy(as_batch(picture[None])), real=is_real)
    return float(distance.compute())


def quality(network: PictureNetwork, pictures: Sequence[Image]) -> float:
    """Mean IQA."""
    return float(np.mean([network(as_batch(picture[None])).mean() for picture in pictures]))


def mean_cosine(cosines: Sequence[float]) -> float:
    """NaN of none: no result showed a face."""
    return float(np.mean(cosines)) if cosines else float("nan")


def paper_table(
    networks: UserNetworks,
    real: Sequence[Image],
    made: Mapping[str, Sequence[Image]],
    cosines: Mapping[str, Sequence[float]],
    speeds: Mapping[str, NDArray[np.float64]],
) -> Table:
    """The paper's columns.

    Args:
        real: source heads on white.
        made: results on white, by method.
        cosines: by method, of the user's embedder.
        speeds: by method, see cvthead.evaluation.speed.frames_per_second; those of the trained
            methods, where measured.
    """
    rows: dict[str, tuple[float | None, ...]] = {}
    for name, pictures in made.items():
        rows[name] = (
            frechet_distance(networks.fid, real, pictures) if networks.fid else None,
            mean_cosine(cosines[name]) if networks.csim else None,
            quality(networks.iqa, pictures) if networks.iqa else None,
            float(speeds[name][0]) if name in speeds else None,
        )
    caption = (
        "The paper's table of cross-identity reenactment; absent is what was not measured, or "
        "needs a network that was not given. The paper's figures are of other people, its frames "
        "per second of an RTX 3090 Ti."
    )
    return Table("cross-identity, paper", caption, COLUMNS, rows | PUBLISHED)
