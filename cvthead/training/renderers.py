"""The networks as training runs them: a batch of samples in, rendered views out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from einops import rearrange, repeat
from torch import Tensor, nn

from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel
from cvthead.model.config import OPEN, Features
from cvthead.model.cvthead import CVTHead
from cvthead.model.paper import PaperCVTHead
from cvthead.model.paper_pixel_aligned import PixelAlignedCVTHead
from cvthead.official.tables import OfficialTables
from cvthead.points import PointLayout
from cvthead.runtime.networks import DESCRIBE_INPUTS
from cvthead.training.config import TrainConfig
from cvthead.training.dataset import VIEWS, PairDataset
from cvthead.training.official_dataset import OfficialPairDataset

Batch = dict[str, Tensor]

VALIDATION_SAMPLES = 32


class OpenRenderer(nn.Module):
    """The open preset; one ``forward``, since distributed training hooks into that."""

    def __init__(self, model: CVTHead) -> None:
        super().__init__()
        self.model = model

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """RGB (b * VIEWS, 3, s, s) in [-1, 1] and mask logits (b * VIEWS, 1, s, s)."""
        descriptors = self.model.describe(*(batch[name] for name in DESCRIBE_INPUTS))
        return self.model.paint(
            rearrange(batch["splatted"], "b v p c -> (b v) p c"),
            repeat(descriptors, "b p c -> (b v) p c", v=VIEWS),
            rearrange(batch["seen"], "b v p -> (b v) p"),
            rearrange(batch["warped"], "b v ... -> (b v) ..."),
        )


class PaperRenderer(nn.Module):
    """The paper's network: the mesh vertices alone are its points.

    On the open head, unlike in the released code, whose encoder sees the portrait's background,
    it sees the person on black, which is what the open records' samples hold.
    """

    def __init__(self, model: PaperCVTHead | PixelAlignedCVTHead, vertices: int) -> None:
        super().__init__()
        self.model, self.vertices = model, vertices

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """As OpenRenderer's."""
        descriptors = self.model.describe(batch["source"], batch["points"][:, : self.vertices])
        driven = rearrange(batch["driven"][:, :, : self.vertices], "b v p c -> (b v) p c")
        descriptors = repeat(descriptors, "b p c -> (b v) p c", v=VIEWS)
        return self.model.paint(driven, descriptors, batch["image"].shape[-1])


Renderer = OpenRenderer | PaperRenderer
Samples = PairDataset | OfficialPairDataset


def training_parts(config: TrainConfig) -> tuple[Samples, Renderer]:
    """Samples of a configuration, and its network with random weights.

    Raises:
        InputError: no records, or those of another preset; no table of labels.
        AssetError: preset official, and nothing was imported.
    """
    samples = _samples(
        config, config.data, samples=config.steps * config.batch, augment=config.augmentation
    )
    if isinstance(samples, OfficialPairDataset):
        return samples, paper_renderer(config.features, samples.tables.hierarchy)
    hierarchy = MeshHierarchy.load()
    if config.preset == "paper":
        return samples, paper_renderer(config.features, hierarchy)
    network = replace(OPEN, features=config.features)
    return samples, OpenRenderer(CVTHead(network, hierarchy, samples.layout))


def validation_samples(config: TrainConfig) -> Samples:
    """Samples of ``config.validation``, the same for every run.

    Raises:
        InputError, AssetError: as :func:`training_parts`.
    """
    assert config.validation is not None
    alike = config.model_copy(update={"seed": 0, "labels": None})
    return _samples(alike, config.validation, samples=VALIDATION_SAMPLES, augment=False)


def _samples(config: TrainConfig, data: Path, *, samples: int, augment: bool) -> Samples:
    common = {"size": config.size, "seed": config.seed + config.size, "samples": samples}
    if config.preset == "official":
        tables = OfficialTables.load(config.imported)
        return OfficialPairDataset(data, tables, deform=config.deformation, **common)
    head = HeadModel.load()
    return PairDataset(
        data,
        head,
        PointLayout.of(head),
        deform=config.deformation,
        all_seen=config.preset == "open" and config.features == "pixel-aligned",
        labels=config.labels,
        augment=augment,
        whole=config.preset == "paper",
        **common,
    )


def paper_renderer(features: Features, hierarchy: MeshHierarchy) -> PaperRenderer:
    """The paper's network on a head, or its ablation with pixel-aligned features."""
    aligned = features == "pixel-aligned"
    model = PixelAlignedCVTHead() if aligned else PaperCVTHead(hierarchy)
    return PaperRenderer(model, hierarchy.counts[0])
