"""Which stills a run sees, and which of their pixels weigh more."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from cvthead.errors import InputError
from cvthead.runtime.place import Placed
from cvthead.training.details import UNSEEN_WEIGHT, unseen_weights
from cvthead.training.records import StoredRecord
from cvthead.training.sampling import group_shares, turned_still

LABELS = "file,group\na/one.jpg,old\na/two.jpg,young\na/three.jpg,young\na/four.jpg,\n"


def stored(name: str, path: Path) -> StoredRecord:
    return StoredRecord(f"{name}.npz", 1, path, 0, path.stat().st_size if path.exists() else 0)


def test_labelled_groups_weigh_the_same(tmp_path: Path) -> None:
    table = tmp_path / "labels.csv"
    table.write_text(LABELS)
    names = ("one", "two", "three", "four", "unknown")
    stills = [stored(name, tmp_path / name) for name in names]
    shares = dict(zip(names, group_shares(stills, table), strict=True))
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["one"] == pytest.approx(shares["two"] + shares["three"])
    assert shares["two"] == shares["three"]
    assert shares["four"] == shares["unknown"] == pytest.approx(1 / 5)
    assert len(set(group_shares(stills, None))) == 1


@pytest.mark.parametrize("text", ["name,group\none,old\n", None])
def test_a_table_without_labels_is_refused(tmp_path: Path, text: str | None) -> None:
    table = tmp_path / "labels.csv"
    if text is not None:
        table.write_text(text)
    with pytest.raises(InputError, match=r"labels\.csv"):
        group_shares([stored("one", tmp_path / "one")], table)


def test_turned_heads_are_seen_more_often(tmp_path: Path) -> None:
    stills = []
    for turn in (0.0, 0.3):
        path = tmp_path / f"{turn}.npz"
        pose = np.zeros((1, 15), np.float32)
        pose[0, 1] = -turn
        np.savez(path, pose=pose)
        stills.append(stored(str(turn), path))
    rng = np.random.default_rng(0)
    shares = group_shares(stills, None)
    seen = Counter(
        float(turned_still(rng, stills, shares).arrays["pose"][0, 1]) for _ in range(200)
    )
    # Frontal only when all three that were drawn are.
    assert seen[0.0] == pytest.approx(200 / 8, abs=15)


def test_what_the_source_hides_weighs_more_than_gaps_between_points() -> None:
    codes = np.full((64, 64, 5), 255, np.uint8)
    codes[20:40, 20:40, 1] = 0  # hidden
    codes[50, :, 1] = 0  # a gap
    codes[:16, :, 1] = 0  # beside the head
    reach = np.full((128, 128), 255, np.uint8)
    reach[:32] = 0
    lent, warped = np.zeros((64, 64), np.float32), np.zeros((128, 128, 4), np.uint8)
    weights = unseen_weights(Placed(codes, warped, reach, lent, lent))
    assert np.all(weights[44:76, 44:76] == 1 + UNSEEN_WEIGHT)
    assert np.all(weights[:32] == 1)
    assert np.all(weights[96:] == 1)
