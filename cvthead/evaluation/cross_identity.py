"""Cross-identity reenactment (paper section 4.2): another person drives the source.

There is no picture to compare with, so a result is judged by the identity it keeps and by what
the tracker finds in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cvthead.evaluation.identity import Embed, Scale, Vector
from cvthead.evaluation.methods import Drawn, Person
from cvthead.evaluation.retracking import Errors, errors, medians, retrack
from cvthead.evaluation.shots import Shot
from cvthead.evaluation.table import Table
from cvthead.tracking.tracker import Tracker

SEED = 0
YAWS = (-30.0, 30.0)  # degrees
COLUMNS = {
    "CSIM, normalised ↑": ".3f",
    "CSIM, raw": ".3f",
    "pose error, degrees ↓": ".2f",
    "jaw error, degrees ↓": ".2f",
    "landmark error, % ↓": ".2f",
    "expression error ↓": ".4f",
    "lost ↓": ".0f",
}
TURNED_COLUMNS = {"CSIM, normalised ↑": ".3f", "CSIM, raw": ".3f", "lost ↓": ".0f"}


@dataclass(frozen=True)
class Found:
    """What is found in one result.

    Attributes:
        errors: against what was asked; None if nothing was asked of another person's face.
        cosine: of the embeddings of result and source; None without an embedder.
    """

    errors: Errors | None
    cosine: float | None


def pairs(identities: Sequence[str], drivers: int, each: int) -> list[tuple[int, int]]:
    """For each clip's source, ``each`` drivers of other people, drawn with SEED.

    Args:
        identities: of the clips.
        drivers: drivers per clip; number d belongs to clip ``d // drivers``.

    Returns:
        (source, driver) numbers.
    """
    rng = np.random.default_rng(SEED)
    chosen = []
    owners = [identity for identity in identities for _ in range(drivers)]
    for source, identity in enumerate(identities):
        others = [number for number, owner in enumerate(owners) if owner != identity]
        picked = rng.permutation(others)[:each]
        chosen += [(source, int(driver)) for driver in picked]
    return chosen


def cross(
    tracker: Tracker,
    embed: Embed | None,
    source: Shot,
    known: Vector | None,
    persons: Mapping[str, Person],
    driver: Shot,
) -> tuple[dict[str, Found | None], dict[str, Drawn]]:
    """Drive all methods' persons, made of one source, by somebody else.

    Args:
        known: embedding of the source.

    Returns:
        What is found in each result, None where no face is; and the results.
    """
    drawn = {name: person.follow(driver) for name, person in persons.items()}
    return {
        name: found(tracker, embed, source, known, result, driver) for name, result in drawn.items()
    }, drawn


def turn(
    tracker: Tracker,
    embed: Embed | None,
    source: Shot,
    known: Vector | None,
    persons: Mapping[str, Person],
) -> tuple[list[dict[str, Found | None]], list[dict[str, Drawn]]]:
    """The source's own face turned by each of YAWS; as :func:`cross`."""
    drawn = [{name: person.turned(yaw) for name, person in persons.items()} for yaw in YAWS]
    return [
        {name: found(tracker, embed, source, known, one, None) for name, one in view.items()}
        for view in drawn
    ], drawn


def found(
    tracker: Tracker,
    embed: Embed | None,
    source: Shot,
    known: Vector | None,
    drawn: Drawn,
    driver: Shot | None,
) -> Found | None:
    shape = source.face.coefficients.shape
    face = retrack(tracker, drawn, shape)
    if face is None:
        return None
    cosine = None
    if embed is not None and known is not None:
        cosine = float(embed(drawn.on_white, face) @ known)
    return Found(errors(tracker, shape, driver, face) if driver else None, cosine)


def cross_table(done: Sequence[Mapping[str, Found | None]], scale: Scale | None) -> Table:
    """Medians over all pairs; results without a face are counted and left out."""
    rows = {}
    for name in done[0]:
        kept = [one for result in done if (one := result[name]) is not None]
        middle = medians([one.errors for one in kept if one.errors is not None])
        figures = middle.pose, middle.jaw, middle.landmarks, middle.expression
        rows[name] = (*csim(kept, scale), *figures, float(len(done) - len(kept)))
    caption = f"Cross-identity: {len(done)} pairs of different people, medians. {explained(scale)}"
    return Table("cross-identity", caption, COLUMNS, rows)


def turned_table(done: Sequence[Mapping[str, Found | None]], scale: Scale | None) -> Table:
    """Medians over all views; results without a face are counted and left out."""
    rows = {}
    for name in done[0]:
        kept = [one for view in done if (one := view[name]) is not None]
        rows[name] = (*csim(kept, scale), float(len(done) - len(kept)))
    caption = (
        f"Identity with the head turned {YAWS[1]:.0f} degrees to either side of the source's "
        f"pose: {len(done)} views, medians."
    )
    return Table("turned", caption, TURNED_COLUMNS, rows)


def csim(kept: Sequence[Found], scale: Scale | None) -> tuple[float | None, float | None]:
    """Normalised and raw median."""
    if scale is None:
        return None, None
    cosines = [one.cosine for one in kept if one.cosine is not None]
    raw = float(np.median(cosines)) if cosines else float("nan")
    return scale.normalised(raw), raw


def explained(scale: Scale | None) -> str:
    if scale is None:
        return "CSIM is absent: no embedder is installed, or there are too few people."
    return (
        f"CSIM's raw median is {scale.different:.3f} for different people (0 when normalised) and "
        f"{scale.same:.3f} for two frames of one clip (1)."
    )
