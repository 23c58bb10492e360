"""How far the colours of hidden points are from what later frames of a clip show there::

    python -m tools.hidden_colours DATA --drivers 4

A point that the source hides and a driving frame shows has its true colour in that frame, but for
the light and the tracker's errors. Three guesses are compared with it: the point across the face as
it is, the nearest points alone, and what cvthead.hidden makes of both.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cvthead.clear import own_colours
from cvthead.evaluation.shots import Shot
from cvthead.head.model import Region
from cvthead.hidden import hidden_colours
from cvthead.pipeline import Pipeline
from cvthead.source import Source, read_source
from tools.clips import clip_arguments, clips

Array = NDArray[np.float32]

PARTS = ("FACE", "EARS", "NECK", "SCALP", "SHOULDERS")


def guesses(pipeline: Pipeline, source: Source) -> dict[str, Array]:
    """(P, 3) in -1..1 of the points on the mesh, by the name of the guess."""
    layout = pipeline.layout
    alone = replace(layout, mirror=np.arange(layout.surface, dtype=np.int32))
    given = source.network_input, source.points, source.clear
    return {
        "across": own_colours(source.network_input, source.points)[layout.mirror],
        "nearest": hidden_colours(alone, *given)[: layout.surface],
        "both": hidden_colours(layout, *given)[: layout.surface],
    }


def compared(
    pipeline: Pipeline, source: Source, driver: Shot
) -> dict[tuple[str, bool, str], Array]:
    """Squared errors, by part, whether the source shows the point across, and guess."""
    layout = pipeline.layout
    shown = read_source(pipeline.deformer, layout, driver.head)
    true = own_colours(shown.network_input, shown.points)[: layout.surface]
    seen = (shown.clear & ~source.clear)[: layout.surface]
    across = source.clear[layout.mirror]
    out = {}
    for name, guess in guesses(pipeline, source).items():
        error = np.square(guess - true).mean(1)
        for part in PARTS:
            own = seen & (layout.region == Region[part])
            for mirrored in (True, False):
                out[part, mirrored, name] = error[own & (across == mirrored)]
    return out


def main(argv: Sequence[str] | None = None) -> None:
    parser = clip_arguments("python -m tools.hidden_colours", __doc__, drivers=4)
    args = parser.parse_args(argv)
    pipeline = Pipeline.load()
    found: dict[tuple[str, bool, str], list[Array]] = defaultdict(list)
    for shot, drivers in clips(pipeline.tracker, args):
        source = read_source(pipeline.deformer, pipeline.layout, shot.head)
        for driver in drivers:
            for key, errors in compared(pipeline, source, driver).items():
                found[key].append(errors)
    print("| hidden points | number | across | nearest | both |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for part in PARTS:
        for mirrored in (True, False):
            every = (found[part, mirrored, name] for name in ("across", "nearest", "both"))
            each = [np.concatenate([np.empty(0, np.float32), *parts]) for parts in every]
            if len(each[0]):
                cells = [f"{np.sqrt(e.mean()):.3f}" for e in each]
                cells[0] = cells[0] if mirrored else ""
                where = "other side seen" if mirrored else "neither side seen"
                print(f"| {part.lower()}, {where} | {len(each[0])} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
