"""Training samples of the official preset: a frame of a video as source, others as drivers.

As the paper trains: two frames of one video (section 3.5), the source's shape on every driver
(equation 2). The random background is ours, the same as for the open preset. Nothing is augmented.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from cvthead.coefficients import Array
from cvthead.official.networks import picture_array
from cvthead.official.projection import project
from cvthead.official.tables import OfficialTables
from cvthead.training.dataset import VIEWS, as_view, targets
from cvthead.training.official_records import OfficialFrame, official_records, stored_frame


class OfficialPairDataset(Dataset[dict[str, Tensor]]):
    """Sample ``i`` depends on ``seed`` and ``i`` alone, so a run resumes exactly."""

    def __init__(
        self,
        folder: Path,
        tables: OfficialTables,
        *,
        size: int,
        seed: int,
        samples: int,
        deform: bool = True,
    ) -> None:
        """Args:
        folder: records, see cvthead.training.official_records.
        tables: of the import that made them.
        size: of the driven views, pixels; below 256 they are shifted by up to half a pixel against
            the splat, which rounds as the released code does.
        samples: length.
        deform: False leaves out hair and shoulders: the ablation without deformation.

        Raises:
            InputError: no records in the folder, or not all of that import.
        """
        self.tables, self.size, self.seed, self.samples = tables, size, seed, samples
        self.deform = deform
        self.stored = official_records(folder, tables.fingerprint)

    def __len__(self) -> int:
        return self.samples

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        cv2.setNumThreads(1)
        rng = np.random.default_rng((self.seed, index))
        stored = self.stored[int(rng.integers(len(self.stored)))]
        arrays = stored.arrays()
        source, *drivers = (
            stored_frame(arrays, int(n))
            for n in rng.choice(stored.frames, 1 + VIEWS, replace=False)
        )
        views = [as_view(driver, self.points(source, driver)) for driver in drivers]
        background = rng.random((1, 3, 1, 1)).astype(np.float32)
        stack = {
            "source": np.concatenate([picture_array(source.image)[0], source.mask[None]]),
            "points": self.points(source, source),
            "background": np.repeat(background, VIEWS, axis=0),
            "driven": np.stack([view.points for view in views]),
            **targets(views, self.size),
        }
        return {
            name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in stack.items()
        }

    def points(self, source: OfficialFrame, driver: OfficialFrame) -> Array:
        """(5023, 3) the source's head and hair, moved as the driver's and seen where it is."""
        offsets = self.tables.offsets(source.hair)
        if not self.deform:
            offsets = np.zeros_like(offsets)
        posed = replace(driver.coefficients, shape=source.coefficients.shape)
        return project(self.tables.head, posed, driver.camera, offsets, driver.square)
