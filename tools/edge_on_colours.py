"""Up to which angle a point's own colour is nearer to the true one than a lent one::

    python -m tools.edge_on_colours DATA --drivers 2

Where the portrait sees a cheek nearly edge-on, a tracker's error of a pixel takes the colour of
the collar or hair behind it. What a driving frame shows of such a point from the front is the true
colour, but for the light; the portrait's own colour there, and the one that cvthead.hidden would
lend from points which are seen less edge-on, are compared with it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cvthead.clear import RIM, own_colours
from cvthead.evaluation.shots import Shot
from cvthead.head.model import Region
from cvthead.hidden import hidden_colours
from cvthead.pipeline import Pipeline
from cvthead.source import Source, read_source
from cvthead.visibility import eroded, inside_mask, towards_camera
from tools.clips import clip_arguments, clips

Array = NDArray[np.float32]

PARTS = ("FACE", "EARS", "NECK", "SCALP", "SHOULDERS")
COSINES = (-0.1, 0.1, 0.2, 0.3, 0.4, 0.5)  # of the way to the camera; edges of the rows
FRONTAL = 0.4  # from which a driving frame is believed


def compared(
    pipeline: Pipeline, source: Source, drivers: Sequence[Shot]
) -> Iterator[tuple[tuple[float, float], str, Array]]:
    """Cosines, part, and squared errors (n, 2) of the own and of the lent colour."""
    layout = pipeline.layout
    count = layout.surface
    towards = towards_camera(layout, source.points)
    shown = source.visible & inside_mask(source.points, eroded(source.head.mask, RIM))
    own = own_colours(source.network_input, source.points)[:count]
    truth = []
    for driver in drivers:
        frame = read_source(pipeline.deformer, layout, driver.head)
        frontal = frame.clear & (towards_camera(layout, frame.points) > FRONTAL)
        truth.append((frontal[:count], own_colours(frame.network_input, frame.points)[:count]))
    for low, high in pairwise(COSINES):
        lenders = shown & (towards >= high)
        lent = hidden_colours(layout, source.network_input, source.points, lenders)[:count]
        between = (shown & (towards >= low) & (towards < high))[:count]
        for seen, true in truth:
            for part in PARTS:
                chosen = between & seen & (layout.region == Region[part])
                errors = [np.square(each - true)[chosen].mean(1) for each in (own, lent)]
                yield (low, high), part, np.stack(errors, axis=1)


def main(argv: Sequence[str] | None = None) -> None:
    parser = clip_arguments("python -m tools.edge_on_colours", __doc__, drivers=2)
    args = parser.parse_args(argv)
    pipeline = Pipeline.load()
    found: dict[tuple[tuple[float, float], str], list[Array]] = defaultdict(list)
    for shot, drivers in clips(pipeline.tracker, args):
        source = read_source(pipeline.deformer, pipeline.layout, shot.head)
        for cosines, part, errors in compared(pipeline, source, drivers):
            found[cosines, part].append(errors)
    print("| cosine | part | points | own | lent |")
    print("| --- | --- | ---: | ---: | ---: |")
    for part in PARTS:
        for low, high in pairwise(COSINES):
            errors = np.concatenate([np.empty((0, 2), np.float32), *found[(low, high), part]])
            if len(errors):
                own, lent = (f"{each:.3f}" for each in np.sqrt(errors.mean(0)))
                print(f"| {low} to {high} | {part.lower()} | {len(errors)} | {own} | {lent} |")


if __name__ == "__main__":
    main()
