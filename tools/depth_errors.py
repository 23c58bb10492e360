"""How much nearer or farther each part of the head would have to be::

    python -m tools.depth_errors DATA --every 2 --drivers 8

Where a result shows something beside the place where the driving frame has it, optical flow tells
by how much. A point that lies too deep by d moves too little by d times the sine of the turn, so
the motion that is left, regressed on the turn over many frames, says how deep each part ought to
lie. Shoulders and neck, which hardly turn, stand for the joint that heads turn at: they ask to be
nearer where that lies too far back.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cvthead.avatar import Avatar
from cvthead.deformation import to_pixels
from cvthead.driving import drive
from cvthead.evaluation.methods import Drawn
from cvthead.evaluation.shots import Shot, rotation
from cvthead.head.model import Region
from cvthead.pipeline import Pipeline
from cvthead.silhouette import pixel_of
from cvthead.visibility import visible_points
from tools.clips import clip_arguments, clips
from tools.st_lpips_parts import flow_between

Array = NDArray[np.float64]

PARTS = ("SHOULDERS", "NECK", "SCALP", "FACE", "EARS")
CONSISTENT = 2.0  # pixels between the flow there and the flow back
FEWEST = 8  # points of a part that must be seen


def residuals(
    pipeline: Pipeline, avatar: Avatar, driver: Shot
) -> Iterator[tuple[str, Array, Array]]:
    """For each part: its name, pixels (2,) that a metre nearer to the source's camera would move
    it by in this frame, and pixels (2,) that it still has to move by."""
    wanted, camera = drive(pipeline.head, avatar, driver.face, crop=driver.head.crop)
    points = pipeline.pose(avatar, wanted, camera)
    shown, target = Drawn.of(pipeline.paint(avatar, points)), driver.head
    pictures = shown.on_white, Drawn(target.image, target.mask).on_white
    there, back = flow_between(*pictures), flow_between(*pictures[::-1])
    both = np.minimum(shown.alpha, target.mask)
    visible = visible_points(pipeline.layout, points, both, camera.scale)
    pixels, size = to_pixels(points), len(there)
    _, column, row = pixel_of(pixels, size)
    flow = there[row, column]
    _, column_there, row_there = pixel_of(pixels + flow, size)
    sure = np.linalg.norm(flow + back[row_there, column_there], axis=1) < CONSISTENT
    seen = (visible & sure)[: pipeline.layout.surface]
    turn = rotation(wanted) @ rotation(avatar.coefficients).T
    nearer = np.array([turn[0, 2], -turn[1, 2]]) * camera.scale * size / 2
    for part in PARTS:
        own = seen & (pipeline.layout.region == Region[part])
        if own.sum() >= FEWEST:
            beside = np.median(flow[: len(own)][own], axis=0)
            yield part, nearer, beside.astype(np.float64)


def main(argv: Sequence[str] | None = None) -> None:
    parser = clip_arguments("python -m tools.depth_errors", __doc__, drivers=8)
    args = parser.parse_args(argv)
    pipeline = Pipeline.load()
    found: dict[str, list[tuple[Array, Array]]] = defaultdict(list)
    for shot, drivers in clips(pipeline.tracker, args):
        avatar = pipeline.encode(shot.image)
        for driver in drivers:
            for part, *values in residuals(pipeline, avatar, driver):
                found[part].append((values[0], values[1]))
    print("| | frames | motion left, pixels (x, y) | nearer by, mm (x) | of it explained |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for part, pairs in found.items():
        nearer, beside = (np.array(each) for each in zip(*pairs, strict=True))
        left = np.sqrt((beside**2).mean(axis=0))
        across, moved = nearer[:, 0], beside[:, 0]
        depth = (across * moved).sum() / (across**2).sum()
        explained = 1 - ((moved - depth * across) ** 2).sum() / (moved**2).sum()
        print(
            f"| {part.lower()} | {len(pairs)} | {left[0]:.1f}, {left[1]:.1f} "
            f"| {1000 * depth:.0f} | {100 * explained:.0f} % |"
        )


if __name__ == "__main__":
    main()
