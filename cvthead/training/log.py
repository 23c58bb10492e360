"""What a run writes for people: log.jsonl, TensorBoard, sample pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from einops import rearrange
from torch import Tensor
from torch.nn import functional as F
from torch.utils.tensorboard import SummaryWriter

from cvthead.files import write_file
from cvthead.training.dataset import VIEWS
from cvthead.training.losses import composite


class RunLog:
    """``log.jsonl`` and ``tensorboard/`` of a run folder.

    Args:
        run: the folder.
        step: of the checkpoint that the run goes on from; later lines, of steps that a kill has
            undone, are removed.
    """

    def __init__(self, run: Path, step: int) -> None:
        path = run / "log.jsonl"
        if path.exists():
            lines = path.read_text().splitlines(keepends=True)
            kept = [ln for ln in lines if ln.endswith("\n") and json.loads(ln)["step"] <= step]
            write_file(path, "".join(kept).encode())
        self._lines = path.open("a")
        self._board = SummaryWriter(str(run / "tensorboard"), purge_step=step + 1)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        rounded = {name: float(f"{value:.6g}") for name, value in values.items()}
        print(json.dumps({"step": step} | rounded), file=self._lines, flush=True)
        for name, value in values.items():
            self._board.add_scalar(name, value, step)

    def picture(self, step: int, pixels: Tensor) -> None:
        """(h, w, 3) in 0..1."""
        self._board.add_image("samples", pixels, step, dataformats="HWC")

    def close(self) -> None:
        self._lines.close()
        self._board.close()


def sample_grid(batch: dict[str, Tensor], rgb: Tensor, logits: Tensor) -> Tensor:
    """(h, w, 3) in 0..1: rows of source, then target and result of each view."""
    size = rgb.shape[-1]
    white = torch.ones((), device=rgb.device)
    source = F.interpolate(batch["source"][:, :3], (size, size)) * 0.5 + 0.5
    target = composite(batch["image"], batch["mask"], white)
    own = composite(rgb.detach() * 0.5 + 0.5, logits.detach().sigmoid(), white)
    own = rearrange(own, "(b v) c h w -> b v c h w", v=VIEWS)
    columns = [source] + [x[:, v] for v in range(VIEWS) for x in (target, own)]
    grid = rearrange(torch.stack(columns), "n b c h w -> (b h) (n w) c")
    return grid.float().clamp(0, 1).cpu()


def save_picture(path: Path, pixels: Tensor) -> None:
    """(h, w, 3) in 0..1 as a picture file."""
    image = (pixels.numpy()[..., ::-1] * 255).astype(np.uint8)
    cv2.imwrite(str(path), np.ascontiguousarray(image))
