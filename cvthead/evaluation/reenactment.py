"""Reenactment of a person by another frame of the same clip (paper section 4.2).

The source's shape with the driver's expression, pose and camera, in the driver's own head crop.
Results are scored against the driving frame itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from cvthead.evaluation.methods import Drawn, Person
from cvthead.evaluation.metrics import Metrics, RegionError, Score, on_white
from cvthead.evaluation.motion import Motion, motion_of
from cvthead.evaluation.retracking import retrack
from cvthead.evaluation.shots import Image, Shot
from cvthead.evaluation.table import Table
from cvthead.evaluation.unseen import HIDDEN, UNSEEN, regions
from cvthead.tracking.tracker import Tracker

SCORES = {"L1 ↓": ".4f", "PSNR ↑": ".2f", "ST-LPIPS ↓": ".4f", "MS-SSIM ↑": ".4f"}
PAPER_SCORES = {"L1 ↓": ".3f", "PSNR ↑": ".2f", "LPIPS ↓": ".3f", "MS-SSIM ↑": ".3f"}
# The paper's table 1 and its ablations: other people, cropped otherwise.
PUBLISHED: dict[str, tuple[float | None, ...]] = {
    "FOMM, paper, VoxCeleb1": (0.048, 22.43, 0.139, 0.836),
    "Bi-Layer, paper, VoxCeleb1": (0.050, 21.48, 0.108, 0.839),
    "ROME, paper, VoxCeleb1": (0.048, 21.13, 0.116, 0.838),
    "CVTHead, paper, VoxCeleb1": (0.041, 22.09, 0.111, 0.840),
    "no deformation, paper, VoxCeleb1": (0.041, 22.47, 0.121, 0.842),
    "pixel-aligned, paper, VoxCeleb1": (0.045, 21.81, 0.107, 0.841),
    "FOMM, paper, VoxCeleb2": (0.059, 20.93, 0.165, 0.793),
    "ROME, paper, VoxCeleb2": (0.050, 20.75, 0.117, 0.834),
    "CVTHead, paper, VoxCeleb2": (0.042, 21.37, 0.119, 0.841),
}
PARTS = {
    "PSNR unseen ↑": ".2f",
    "L1 unseen ↓": ".4f",
    "PSNR hidden ↑": ".2f",
    "L1 hidden ↓": ".4f",
}


@dataclass(frozen=True, eq=False)
class Reenactment:
    """Figures of one driving frame, by method.

    Attributes:
        clip, frame: of the driver.
        scores: both pictures composited by the target's mask.
        own_matte: the same with each result composited by its own mask.
        parts: by region (see cvthead.evaluation.unseen), over its pixels alone, composited by
            the target's mask.
        person: pixels of the driver.
    """

    clip: str
    frame: int
    scores: Mapping[str, Score]
    own_matte: Mapping[str, Score]
    parts: Mapping[str, Mapping[str, RegionError]]
    person: int


def reenact(
    metrics: Metrics, persons: Mapping[str, Person], visible: Person, driver: Shot
) -> tuple[Reenactment, dict[str, Drawn]]:
    """Drive all methods' persons, made of one source, by one frame of the same clip.

    Args:
        persons: by method.
        visible: the same source from :func:`cvthead.evaluation.unseen.visibility`.

    Returns:
        The figures, and each method's result.
    """
    target = driver.head
    drawn = {name: person.follow(driver) for name, person in persons.items()}
    wanted = on_white(target.image, target.mask)
    pictures = [on_white(result.rgb, target.mask) for result in drawn.values()]
    mattes = [on_white(result.rgb, result.alpha) for result in drawn.values()]
    scores = metrics.scores(pictures + mattes, wanted, target.mask, target.valid)
    parts = {
        region: {
            name: RegionError.of(picture, wanted, pixels)
            for name, picture in zip(drawn, pictures, strict=True)
        }
        for region, pixels in regions(visible.follow(driver), driver).items()
    }
    figures = Reenactment(
        driver.name,
        driver.number,
        dict(zip(drawn, scores, strict=False)),
        dict(zip(drawn, scores[len(drawn) :], strict=True)),
        parts,
        int(((target.mask > 0.5) & target.valid).sum()),
    )
    return figures, drawn


def followed(
    tracker: Tracker, source: Shot, driver: Shot, drawn: Drawn
) -> tuple[Motion, Motion | None]:
    """What the driver does, and what is tracked in the result; None if no face is found."""
    got = retrack(tracker, drawn, source.face.coefficients.shape)
    networks = tracker.networks
    return motion_of(driver.face, networks), motion_of(got, networks) if got else None


def mean(scores: Sequence[Score]) -> Score:
    """Of each figure; a figure that one of the scores lacks is absent."""
    columns = [[getattr(score, field.name) for score in scores] for field in fields(Score)]
    return Score(*(None if None in column else float(np.mean(column)) for column in columns))  # type: ignore[arg-type]


def by_clip(done: Sequence[Reenactment], method: str, *, own: bool = False) -> dict[str, Score]:
    """Mean of each clip's frames."""
    found: dict[str, list[Score]] = {}
    for one in done:
        score = (one.own_matte if own else one.scores)[method]
        found.setdefault(one.clip, []).append(score)
    return {clip: mean(scores) for clip, scores in found.items()}


def score_table(key: str, caption: str, done: Sequence[Reenactment], *, own: bool = False) -> Table:
    """Mean of the clips' means per method."""
    detail = {method: by_clip(done, method, own=own) for method in done[0].scores}
    rows = {}
    for method, clips in detail.items():
        score = mean(list(clips.values()))
        rows[method] = (score.l1, score.psnr, score.st_lpips, score.ms_ssim)
    by_method = {
        method: {clip: vars(score) for clip, score in scores.items()}
        for method, scores in detail.items()
    }
    return Table(key, caption, SCORES, rows, detail={"clips": by_method})


def paper_table(done: Sequence[Reenactment], *, released: bool) -> Table:
    """The columns of the paper's table of self-reenactment, its own figures below.

    Args:
        done: one or more.
        released: composite each result by its own mask, as the released evaluation does; else by
            the target's.
    """
    rows: dict[str, tuple[float | None, ...]] = {}
    for method in done[0].scores:
        score = mean(list(by_clip(done, method, own=released).values()))
        rows[method] = (score.l1, score.psnr, score.lpips, score.ms_ssim)
    whose = "its own mask, as in the released evaluation" if released else "the target's mask"
    caption = (
        f"The paper's columns, each result on white by {whose}; LPIPS is absent without a network "
        "for it."
    )
    return Table("self-reenactment, paper", caption, PAPER_SCORES, rows | PUBLISHED)


def part_table(key: str, caption: str, done: Sequence[Reenactment]) -> Table:
    """Errors over all pixels of a region together, per method."""
    rows = {}
    for method in done[0].scores:
        unseen, hidden = (
            sum((one.parts[region][method] for one in done), RegionError(0, 0, 0))
            for region in (UNSEEN, HIDDEN)
        )
        rows[method] = (unseen.psnr, unseen.l1, hidden.psnr, hidden.l1)
    return Table(key, f"{caption} {shares(done)}", PARTS, rows)


def shares(done: Sequence[Reenactment]) -> str:
    """How many of the person's pixels each region has."""
    method = next(iter(done[0].scores))
    person = sum(one.person for one in done)
    unseen, hidden = (
        sum(one.parts[region][method].count for one in done) / person for region in (UNSEEN, HIDDEN)
    )
    return f"Unseen are {unseen:.1%} of the person's pixels, hidden {hidden:.1%}."


def picture(driver: Shot) -> Image:
    """(256, 256, 3) the driver's head on white."""
    return Drawn(driver.head.image, driver.head.mask).on_white
