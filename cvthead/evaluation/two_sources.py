"""Two frames of one clip as sources: their avatars, driven by a third, should look the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cvthead.evaluation.methods import Drawn, Person
from cvthead.evaluation.metrics import Metrics, Score, on_white
from cvthead.evaluation.reenactment import mean
from cvthead.evaluation.shots import Shot
from cvthead.evaluation.table import Table

COLUMNS = {"PSNR ↑": ".2f", "ST-LPIPS ↓": ".4f"}


def likeness(
    metrics: Metrics,
    first: Mapping[str, Person],
    second: Mapping[str, Person],
    driver: Shot,
) -> tuple[dict[str, Score], dict[str, tuple[Drawn, Drawn]]]:
    """The distance between two avatars of one person, by method.

    Each picture is composited on white by its own mask, so hair and outline count.

    Args:
        first, second: the same methods, of two source frames.
    """
    figures, drawn = {}, {}
    everywhere = np.ones_like(driver.head.valid)
    for name, person in first.items():
        drawn[name] = person.follow(driver), second[name].follow(driver)
        a, b = (on_white(one.rgb, one.alpha) for one in drawn[name])
        figures[name] = metrics.scores([a], b, driver.head.mask, everywhere)[0]
    return figures, drawn


def likeness_table(done: Sequence[Mapping[str, Score]]) -> Table:
    caption = (
        f"Two sources of one person: avatars of the first and the middle frame of {len(done)} "
        "clips, driven by the last one, against each other."
    )
    scores = {name: mean([one[name] for one in done]) for name in done[0]}
    rows = {name: (score.psnr, score.st_lpips) for name, score in scores.items()}
    return Table("two sources", caption, COLUMNS, rows)
