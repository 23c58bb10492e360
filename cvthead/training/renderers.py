"""The networks as training runs them: a batch of PairDataset in, rendered views out."""

from __future__ import annotations

from dataclasses import replace

from einops import rearrange, repeat
from torch import Tensor, nn

from cvthead.head.hierarchy import MeshHierarchy
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.model.paper import PaperCVTHead
from cvthead.model.paper_pixel_aligned import PixelAlignedCVTHead
from cvthead.points import PointLayout
from cvthead.training.config import TrainConfig
from cvthead.training.dataset import VIEWS

Batch = dict[str, Tensor]


class OpenRenderer(nn.Module):
    """The open preset; one ``forward``, since distributed training hooks into that."""

    def __init__(self, model: CVTHead) -> None:
        super().__init__()
        self.model = model

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """RGB (b * VIEWS, 3, s, s) in [-1, 1] and mask logits (b * VIEWS, 1, s, s)."""
        descriptors = self.model.describe(
            batch["source"], batch["points"], batch["visible"], batch["anchor"]
        )
        return self.model.paint(
            rearrange(batch["driven"], "b v p c -> (b v) p c"),
            repeat(descriptors, "b p c -> (b v) p c", v=VIEWS),
            rearrange(batch["seen"], "b v p -> (b v) p"),
            rearrange(batch["warped"], "b v ... -> (b v) ..."),
        )


class PaperRenderer(nn.Module):
    """The paper's network on the open head: its mesh vertices alone are the points.

    Unlike the released code, whose encoder sees the portrait's background, this one sees the
    person on black, which is what the records' samples hold.
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


def build_renderer(config: TrainConfig, layout: PointLayout) -> OpenRenderer | PaperRenderer:
    """The network of a configuration, with random weights."""
    hierarchy = MeshHierarchy.load()
    if config.preset == "paper":
        aligned = config.features == "pixel-aligned"
        model = PixelAlignedCVTHead() if aligned else PaperCVTHead(hierarchy)
        return PaperRenderer(model, layout.vertices)
    return OpenRenderer(CVTHead(replace(OPEN, features=config.features), hierarchy, layout))
