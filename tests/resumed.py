"""Runs on two processes, once straight and once with a break, and whether both end the same."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from made_records import make_records

from cvthead.errors import AssetError
from cvthead.training.perceptual import perceptual_weights

BROKEN_RUNS = Path(__file__).parent / "broken_runs.py"
COMMON = """\
data = {data}
size = 32
steps = 2
batch = 2
workers = 0
log_every = 1
save_every = 2
average = 0.5
precision = "32-true"
"""


def run_with_breaks(folder: Path, configurations: Mapping[str, str]) -> None:
    """Run each configuration on made-up records as broken_runs.py does; skips without the
    perceptual weights."""
    try:
        perceptual_weights("alex")
    except AssetError as error:
        pytest.skip(f"no perceptual weights: {error}")
    records = folder / "records"
    records.mkdir()
    make_records(records, views=2)
    for name, text in configurations.items():
        (folder / f"{name}.toml").write_text(COMMON.format(data=f'"{records}"') + text)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc-per-node", "2", str(BROKEN_RUNS), str(folder)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def assert_a_break_changed_nothing(run: Path, *, adversary: bool) -> None:
    """``run`` is the folder of a configuration."""
    whole, broken = (
        torch.load(run / kind / "checkpoint.pt", weights_only=True, mmap=True)
        for kind in ("whole", "broken")
    )
    assert whole["step"] == broken["step"] == 2
    assert whole["began_with"] == broken["began_with"] == "random weights"
    assert whole.keys() == broken.keys()
    assert ("discriminator_optimizer" in whole) == adversary
    for part in whole.keys() - {"config"}:
        assert_same(whole[part], broken[part], part)


def assert_same(one: Any, other: Any, where: str) -> None:
    """Nested tensors and numbers; only the order of sums may differ."""
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            assert_same(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, list):
        for number, pair in enumerate(zip(one, other, strict=True)):
            assert_same(*pair, f"{where}.{number}")
    elif isinstance(one, torch.Tensor):
        if torch.equal(one, other):  # much faster, and the rule
            return
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6, msg=lambda m: f"{where}: {m}")
    elif isinstance(one, float):
        assert one == pytest.approx(other, rel=1e-4), where
    else:
        assert one == other, where
