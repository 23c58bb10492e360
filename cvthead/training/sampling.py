"""Which stills a training run sees: every group alike, and turned heads more often than most."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvthead.errors import InputError
from cvthead.training.records import Record, StoredRecord

# Stills that are drawn for a sample; the most turned stays. Most portraits are frontal, and the
# mirror image of those shows nothing that the source hides.
CANDIDATES = 3


def group_shares(stills: Sequence[StoredRecord], labels: Path | None) -> NDArray[np.float64]:
    """Probability (N,) of each still: labelled groups weigh the same, and those without a label
    keep the share that they have.

    Args:
        labels: CSV table with the columns file and group; None weighs all stills the same.

    Raises:
        InputError: the table cannot be read or lacks these columns.
    """
    if labels is None:
        return np.full(len(stills), 1 / max(1, len(stills)))
    groups = read_labels(labels)
    own = [groups.get(Path(still.name).stem, "") for still in stills]
    counts = Counter(own)
    labelled = len(own) - counts[""]
    named = len(counts) - ("" in counts)
    weights = [labelled / named / counts[group] if group else 1.0 for group in own]
    return np.array(weights) / len(own)


def read_labels(table: Path) -> dict[str, str]:
    """File name without its ending -> group, of a CSV table.

    Raises:
        InputError: as :func:`group_shares`.
    """
    try:
        with table.open(newline="") as file:
            return {Path(row["file"]).stem: row["group"] for row in csv.DictReader(file)}
    except (OSError, KeyError, UnicodeDecodeError) as error:
        raise InputError(
            f"{table} is no table of labels: {error}", hint="give a CSV with columns file and group"
        ) from error


def turned_still(
    rng: np.random.Generator, stills: Sequence[StoredRecord], shares: NDArray[np.float64]
) -> Record:
    """The most turned of a few stills drawn at random."""
    drawn = rng.choice(len(stills), CANDIDATES, p=shares)
    return max((stills[int(number)].open() for number in drawn), key=turn)


def turn(record: Record) -> float:
    """How far the first frame is turned about the vertical, radians."""
    pose = record.arrays["pose"][0]
    return abs(float(pose[1] + pose[4]))  # global and neck
