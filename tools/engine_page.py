"""Served frames beside those of the float32 network, as a table and a page to look at::

    python -m tools.engine_page out/engines PORTRAIT...

The service paints with 8-bit integers; this shows what that changes. The float side is the trained
network in PyTorch, from the same weights, splat and carried portrait.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvthead.avatar import Avatar
from cvthead.camera import CROP_PIXELS
from cvthead.controls import Controls, resolve
from cvthead.deformation import MAX_SHELL_POINTS
from cvthead.evaluation.page import Grid, write_page
from cvthead.frame import Frame
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.images import read_image
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.model.splat import splat
from cvthead.pipeline import Pipeline
from cvthead.points import FAR_AWAY
from cvthead.runtime.face import splatted
from cvthead.runtime.mix import composed
from cvthead.runtime.model_folder import WEIGHTS, packaged
from cvthead.runtime.threads import one_thread_per_call
from cvthead.source import Source, as_network_input, cut_head, read_source
from cvthead.training.static_int8 import psnr
from cvthead.weights import load_into

Image = NDArray[np.uint8]

WHITE = (255, 255, 255)
MAGNIFIED = 8  # of the difference that the page shows
POSES = {
    "turned left, jaw open": Controls(global_rotation=(0, 0.5, 0), arkit={"jawOpen": 0.6}),
    "as the portrait": Controls(),
    "turned right, smiling": Controls(
        global_rotation=(0, -0.5, 0), arkit={"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9}
    ),
    "eyes shut": Controls(arkit={"eyeBlinkLeft": 1, "eyeBlinkRight": 1}),
}


@dataclass(frozen=True, eq=False)
class FloatNetwork:
    """The open preset's networks in float32 PyTorch."""

    model: CVTHead
    pipeline: Pipeline

    @classmethod
    def load(cls, pipeline: Pipeline) -> FloatNetwork:
        """From the packaged weights, which the pipeline's networks were made of."""
        model = CVTHead(OPEN, MeshHierarchy.load(), pipeline.layout)
        fingerprint = load_into(model, packaged("open") / WEIGHTS)
        assert fingerprint == pipeline.fingerprint
        return cls(model.eval().requires_grad_(False), pipeline)

    def describe(self, source: Source) -> Tensor:
        """(1, P, C) descriptors of all points of the layout."""
        anchor = np.zeros(MAX_SHELL_POINTS, np.int64)
        anchor[: len(source.deformation.shell_anchor)] = source.deformation.shell_anchor
        clear = source.clear.astype(np.float32)
        hidden = source.hidden(self.pipeline.layout)
        inputs = (source.network_input, source.points, clear, anchor, hidden)
        return self.model.describe(*(torch.from_numpy(x)[None] for x in inputs))

    def paint(
        self, avatar: Avatar, source: Source, descriptors: Tensor, points: NDArray[np.float32]
    ) -> Frame:
        """The frame of driven points (P, 3), before any rounding but the last.

        Args:
            descriptors: of :meth:`describe`.
        """
        layout = self.pipeline.layout
        every = np.tile(FAR_AWAY, (layout.total, 1))
        every[: len(points)] = splatted(layout, points, CROP_PIXELS)
        placed = self.pipeline.place(avatar, points)
        seen = torch.from_numpy(source.places(layout)[None, :, 2])
        values = torch.cat([descriptors, seen[..., None]], dim=-1)
        image = splat(torch.from_numpy(every)[None], values, len(placed.lent))
        warped = torch.from_numpy(as_network_input(placed.warped))[None]
        painted, logits, gate = self.model.unet.parts(self.model.filled(image), warped)
        # Beside sharp edges the filter over what is painted overshoots.
        colour, opaque = ((painted + 1) * 127.5).clamp(0, 255), logits.sigmoid() * 255
        exact = torch.cat([colour, opaque], dim=1)[0].permute(1, 2, 0).round().to(torch.uint8)
        rgba = exact.numpy()
        alpha = np.ascontiguousarray(rgba[..., 3])
        return Frame.of_rgba(composed(rgba, alpha, gate[0, 0].numpy(), placed))


def compare(network: FloatNetwork, portrait: Path) -> tuple[Grid, list[float]]:
    """Rows of served, float32 and magnified difference for each pose; and their PSNR, dB."""
    pipeline = network.pipeline
    image = read_image(portrait)
    avatar = pipeline.encode(image)
    crop = cut_head(pipeline.tracker, image, pipeline.tracker.track(image))
    source = read_source(pipeline.deformer, pipeline.layout, crop)
    descriptors = network.describe(source)
    rows, distances = {}, []
    for name, controls in POSES.items():
        pose = resolve(avatar.coefficients, avatar.camera, controls, pipeline.arkit)
        points = pipeline.pose(avatar, *pose)
        frames = pipeline.paint(avatar, points), network.paint(avatar, source, descriptors, points)
        distances.append(psnr(*(frame.rgba() for frame in frames)))
        served, exact = (frame.over(WHITE) for frame in frames)
        off = cv2.convertScaleAbs(cv2.absdiff(served, exact), alpha=MAGNIFIED)
        rows[f"{name}: {distances[-1]:.1f} dB"] = (served, exact, off.astype(np.uint8))
    titles = ("served (8-bit)", "float32", f"difference x {MAGNIFIED}")
    return Grid(portrait.stem, titles, rows), distances


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.engine_page", description=__doc__)
    parser.add_argument("output", type=Path, help="folder of the page")
    parser.add_argument("portraits", type=Path, nargs="+", help="pictures of faces")
    args = parser.parse_args(argv)
    one_thread_per_call()
    network = FloatNetwork.load(Pipeline.load())
    grids, lines = [], ["| portrait | median dB | lowest dB |", "| --- | ---: | ---: |"]
    every: list[float] = []
    for portrait in args.portraits:
        grid, distances = compare(network, portrait)
        grids.append(grid)
        every += distances
        lines.append(f"| {portrait.stem} | {np.median(distances):.1f} | {min(distances):.1f} |")
    lines.append(f"| all | {np.median(every):.1f} | {min(every):.1f} |")
    print("\n".join(lines))
    print(f"\n{write_page(args.output, chr(10).join(lines), {'Portraits': grids})}")


if __name__ == "__main__":
    main()
