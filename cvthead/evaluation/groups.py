"""Stills by group: is everybody served alike?

Each still is encoded and asked for its own pose (same image) and for that of its mirrored
picture, which is then compared with the mirrored picture: a view from the other side.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvthead.errors import InputError
from cvthead.evaluation.methods import Person
from cvthead.evaluation.metrics import Metrics, Score, on_white
from cvthead.evaluation.reenactment import mean
from cvthead.evaluation.shots import Shot, shoot
from cvthead.evaluation.table import Table
from cvthead.images import read_image
from cvthead.tracking.tracker import Tracker

COLUMNS = {
    "stills": ".0f",
    "PSNR, same ↑": ".2f",
    "ST-LPIPS, same ↓": ".4f",
    "MS-SSIM, same ↑": ".4f",
    "PSNR, mirrored ↑": ".2f",
    "ST-LPIPS, mirrored ↓": ".4f",
    "MS-SSIM, mirrored ↑": ".4f",
}
ALL = "all"


@dataclass(frozen=True)
class Still:
    """A picture of the validation set and the label its source gives it."""

    path: Path
    group: str


@dataclass(frozen=True)
class Reconstruction:
    """One still, by trained method: the same picture and the mirrored one."""

    group: str
    same: Mapping[str, Score]
    mirrored: Mapping[str, Score]


def read_stills(data: Path) -> list[Still]:
    """The stills of the split ``val`` of ``stills.csv``, none without that table; those without a
    label go by their set.

    Raises:
        InputError: the table cannot be read, or lacks the columns file, split, set and group.
    """
    path = data / "stills.csv"
    if not path.exists():
        return []
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [
                Still(data / row["file"], row["group"] or row["set"])
                for row in csv.DictReader(file)
                if row["split"] == "val"
            ]
    except (OSError, KeyError) as error:
        raise InputError(
            f"{path} is no table of stills: {error}", hint="see docs/evaluation.md"
        ) from error


def shots_of(tracker: Tracker, still: Still) -> tuple[Shot, Shot] | None:
    """The still and its mirror image with the same shape; None if a face is not found."""
    image = read_image(still.path)
    source = shoot(tracker, still.path.stem, 0, image)
    if source is None:
        return None
    shape = source.face.coefficients.shape
    flipped = np.ascontiguousarray(image[:, ::-1])
    mirrored = shoot(tracker, still.path.stem, 1, flipped, shape=shape)
    return (source, mirrored) if mirrored else None


def reconstruct(
    metrics: Metrics, group: str, persons: Mapping[str, Person], source: Shot, mirrored: Shot
) -> Reconstruction:
    """Score the methods' persons, made of the source, both ways; composited by the target's
    mask."""
    scores = [
        {name: score(metrics, person, target) for name, person in persons.items()}
        for target in (source, mirrored)
    ]
    return Reconstruction(group, *scores)


def score(metrics: Metrics, person: Person, target: Shot) -> Score:
    head = target.head
    result = on_white(person.follow(target).rgb, head.mask)
    return metrics.scores([result], on_white(head.image, head.mask), head.mask, head.valid)[0]


def group_tables(done: Sequence[Reconstruction], tried: int) -> list[Table]:
    """One table per method, a row per label and one over all."""
    caption = (
        f"Stills by the label their source gives them: the same image and its mirror image. "
        f"{len(done)} of {tried} stills could be tracked both ways."
    )
    return [
        Table(f"groups, {name}", f"{caption} {name}:", COLUMNS, rows_of(done, name), "label")
        for name in done[0].same
    ]


def rows_of(done: Sequence[Reconstruction], name: str) -> dict[str, list[float | None]]:
    rows: dict[str, list[float | None]] = {}
    for group in [*sorted({one.group for one in done}), ALL]:
        chosen = [one for one in done if group in (ALL, one.group)]
        same = mean([one.same[name] for one in chosen])
        mirrored = mean([one.mirrored[name] for one in chosen])
        figures = [(s.psnr, s.st_lpips, s.ms_ssim) for s in (same, mirrored)]
        rows[group] = [float(len(chosen)), *figures[0], *figures[1]]
    return rows
