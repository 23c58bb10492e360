"""Whether a point that is seen edge-on has its own colour, by what the colour looks like::

    python -m tools.edge_on_colours DATA --drivers 2

Where the portrait sees a cheek nearly edge-on, a tracker's error of a pixel takes the colour of
the collar or wall behind it. What a driving frame shows of such a point from the front is the true
colour, but for the light; the portrait's own colour there, and the one that cvthead.hidden would
lend from points which are not seen edge-on, are compared with it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cvthead.clear import EDGE_ON, SKIN, doubtful_points, like_skin_and_hair, own_colours
from cvthead.evaluation.shots import Shot
from cvthead.hidden import hidden_colours
from cvthead.pipeline import Pipeline
from cvthead.source import Source, read_source
from cvthead.visibility import towards_camera
from tools.clips import clip_arguments, clips

Array = NDArray[np.float32]

FRONTAL = 0.4  # cosine from which a driving frame is believed


def compared(
    pipeline: Pipeline, source: Source, drivers: Sequence[Shot]
) -> Iterator[tuple[str, str, Array]]:
    """Part, look, and squared errors (n, 2) of the own and of the lent colour."""
    layout = pipeline.layout
    count = layout.surface
    given = layout, source.network_input, source.points
    sure, doubtful = doubtful_points(*given, source.visible)
    colours = own_colours(*given[1:])
    skin, hair = like_skin_and_hair(layout, colours, sure)
    lent = hidden_colours(*given, sure)[:count]
    kinds = {"skin": skin, "hair": hair & ~skin, "neither": ~skin & ~hair}
    for driver in drivers:
        frame = read_source(pipeline.deformer, layout, driver.head)
        frontal = frame.clear & (towards_camera(layout, frame.points) > FRONTAL)
        seen = (doubtful & frontal)[:count]
        true = own_colours(frame.network_input, frame.points)[:count]
        for part in SKIN:
            for name, kind in kinds.items():
                chosen = seen & kind[:count] & (layout.region == part)
                both = (colours[:count], lent)
                errors = [np.square(each - true)[chosen].mean(1) for each in both]
                yield part.name.lower(), name, np.stack(errors, axis=1)


def main(argv: Sequence[str] | None = None) -> None:
    parser = clip_arguments("python -m tools.edge_on_colours", __doc__, drivers=2)
    args = parser.parse_args(argv)
    pipeline = Pipeline.load()
    found: dict[tuple[str, str], list[Array]] = defaultdict(list)
    for shot, drivers in clips(pipeline.tracker, args):
        source = read_source(pipeline.deformer, pipeline.layout, shot.head)
        for part, look, errors in compared(pipeline, source, drivers):
            found[part, look].append(errors)
    print(f"Points seen at a cosine of at most {EDGE_ON}.\n")
    print("| part | looks like | points | own | lent |")
    print("| --- | --- | ---: | ---: | ---: |")
    for (part, look), each in sorted(found.items()):
        errors = np.concatenate(each)
        if len(errors):
            own, lent = (f"{value:.3f}" for value in np.sqrt(errors.mean(0)))
            print(f"| {part} | {look} | {len(errors)} | {own} | {lent} |")


if __name__ == "__main__":
    main()
