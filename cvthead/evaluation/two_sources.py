"""Two frames of one clip as sources: their avatars, driven by a third, should look the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cvthead.evaluation.methods import Drawn, Person
from cvthead.evaluation.metrics import Metrics, on_white
from cvthead.evaluation.shots import Shot
from cvthead.evaluation.table import Table

COLUMNS = {"PSNR ↑": ".2f", "ST-LPIPS ↓": ".4f"}

Likeness = tuple[float, float]


def likeness(
    metrics: Metrics,
    first: Mapping[str, Person],
    second: Mapping[str, Person],
    driver: Shot,
) -> tuple[dict[str, Likeness], dict[str, tuple[Drawn, Drawn]]]:
    """PSNR in dB and ST-LPIPS between two avatars of one person, by method.

    Each picture is composited on white by its own mask, so hair and outline count.

    Args:
        first, second: the same methods, of two source frames.
    """
    figures, drawn = {}, {}
    everywhere = np.ones_like(driver.head.valid)
    for name, person in first.items():
        drawn[name] = person.follow(driver), second[name].follow(driver)
        a, b = (on_white(one.rgb, one.alpha) for one in drawn[name])
        score = metrics.scores([a], b, driver.head.mask, everywhere)[0]
        figures[name] = score.psnr, score.st_lpips
    return figures, drawn


def likeness_table(done: Sequence[Mapping[str, Likeness]]) -> Table:
    caption = (
        f"Two sources of one person: avatars of the first and the middle frame of {len(done)} "
        "clips, driven by the last one, against each other."
    )
    rows = {
        name: [float(np.mean([one[name][k] for one in done])) for k in (0, 1)] for name in done[0]
    }
    return Table("two sources", caption, COLUMNS, rows)
