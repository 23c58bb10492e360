"""How well hair and shoulders fill the person: ``python -m cvthead.evaluation.deformation``.

Takes the stills below a directory (default ``../shared/data/stills/val``) and prints the
intersection over union with the person mask, inside the picture, of the bald head, of the
deformed mesh and of the mesh with its shell points, each as a disc of SHELL_SPACING radius.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np

from cvthead.camera import CROP_PIXELS
from cvthead.deformation import (
    SHELL_SPACING,
    Deformation,
    DeformationModel,
    inside,
    points,
    to_pixels,
)
from cvthead.errors import FaceError
from cvthead.evaluation.tracking import read_image
from cvthead.head.model import Region
from cvthead.silhouette import distance_to_points, overlap, pixel_of, rasterise
from cvthead.source import HeadCrop, cut_head
from cvthead.tracking.tracker import Tracker

TARGET_OVERLAP, TARGET_EAR, TARGET_MILLISECONDS = 0.90, 5.0, 150.0


@dataclass(frozen=True)
class StillResult:
    """One still.

    Attributes:
        bald: intersection over union with the person mask of the plain head, 0..1.
        mesh: of the deformed mesh.
        shell: of the deformed mesh and its shell points.
        outside: share of the vertices within the picture that project onto the background.
        count: shell points.
        ear: largest displacement of an ear vertex in millimetres.
        milliseconds: CPU time of the fit.
    """

    bald: float
    mesh: float
    shell: float
    outside: float
    count: int
    ear: float
    milliseconds: float


def measure(model: DeformationModel, still: HeadCrop) -> StillResult:
    """Fit one head crop and compare with its mask."""
    head, camera, valid, mask = model.head, still.camera, still.valid, still.mask > 0.5
    start = time.thread_time()
    deformation = model.fit(still.coefficients, camera, mask, valid)
    seconds = time.thread_time() - start
    size, vertices = CROP_PIXELS, len(head.template)
    bald = points(head, still.coefficients, Deformation.none(head))
    posed = points(head, still.coefficients, deformation)
    flat = to_pixels(camera.project(posed))
    mesh = rasterise(flat[:vertices], head.faces, size)
    discs = np.zeros_like(mesh)
    if vertices < len(posed):
        discs = distance_to_points(flat[vertices:], size) <= SHELL_SPACING
    within, column, row = pixel_of(flat[:vertices], size)
    known = within & valid[row, column]
    ears = deformation.offsets[head.region == Region.EARS]
    return StillResult(
        bald=overlap(rasterise(to_pixels(camera.project(bald)), head.faces, size), mask, valid),
        mesh=overlap(mesh, mask, valid),
        shell=overlap(mesh | discs, mask, valid),
        outside=float(1 - inside(posed[:vertices], camera, mask)[known].mean()),
        count=len(deformation.shell_anchor),
        ear=float(np.linalg.norm(ears, axis=1).max() * 1e3),
        milliseconds=seconds * 1e3,
    )


def report(results: Sequence[StillResult]) -> list[str]:
    """The table."""
    table = np.array([astuple(result) for result in results])
    lines = [f"{'':22s}{'mean':>8s}{'median':>8s}{'worst':>8s}"]
    names = (
        ("IoU bald head", min, ""),
        ("IoU mesh", min, f"target {TARGET_OVERLAP} mean and median"),
        ("IoU mesh and shell", min, ""),
        ("vertices outside", max, ""),
        ("shell points", max, ""),
        ("ear, mm", max, f"target {TARGET_EAR:g} at most"),
        ("fit, CPU ms", max, f"target {TARGET_MILLISECONDS:g}"),
    )
    for (name, worst, target), column in zip(names, table.T, strict=True):
        row = f"{column.mean():8.3f}{np.median(column):8.3f}{worst(column):8.3f}"
        lines.append(f"{name:22s}{row}  {target}".rstrip())
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    default = Path(os.environ.get("CVTHEAD_SHARED", "../shared")) / "data/stills/val"
    parser.add_argument("stills", type=Path, nargs="?", default=default)
    parser.add_argument("--limit", type=int, help="at most so many stills, evenly spread")
    options = parser.parse_args(arguments)
    paths = sorted(path for path in options.stills.iterdir() if path.is_file())
    if options.limit:
        paths = paths[:: max(1, len(paths) // options.limit)][: options.limit]
    tracker = Tracker.load()
    model = DeformationModel.from_head(tracker.head)
    results = []
    for path in paths:
        image = read_image(path)
        try:
            results.append(measure(model, cut_head(tracker, image, tracker.track(image))))
        except FaceError as error:
            print(f"{path.name}: {error}")
    print(f"{len(results)} of {len(paths)} stills")
    print("\n".join(report(results)))


if __name__ == "__main__":
    main()
