"""Two processes go on from a checkpoint as if nothing had happened: the adversarial stage and the
ablations. tests/test_training.py kills a run, tests/nightly has the paper's network."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from resumed import assert_a_break_changed_nothing, run_with_breaks

CONFIGURATIONS = {
    "adversarial": "stage = 2\n[losses]\nadversarial = 0.1\nfeature_matching = 1.0\n",
    "pixel-aligned": 'features = "pixel-aligned"\n',
    "transformer": 'features = "transformer"\n',
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("runs")
    run_with_breaks(folder, CONFIGURATIONS)
    yield folder
    shutil.rmtree(folder)  # hundreds of megabytes


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_a_break_changes_nothing(runs: Path, name: str) -> None:
    assert_a_break_changed_nothing(runs / name, adversary=name == "adversarial")
