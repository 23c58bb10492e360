"""Two processes go on from a checkpoint as if nothing had happened: the paper's network with its
adversary, and the ablations. tests/test_training.py kills a run of the open preset."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from made_loss_networks import made_vgg
from made_records import make_records

from cvthead.errors import AssetError
from cvthead.training.perceptual import perceptual_weights

BROKEN_RUNS = Path(__file__).parent / "broken_runs.py"
STAGE_2 = "stage = 2\n[losses]\nadversarial = 0.1\nfeature_matching = 1.0\n"
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


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What broken_runs.py leaves, of three small configurations."""
    try:
        perceptual_weights("alex")
    except AssetError as error:
        pytest.skip(f"no perceptual weights: {error}")
    folder = tmp_path_factory.mktemp("runs")
    records, weights = folder / "records", tmp_path_factory.mktemp("weights")
    records.mkdir()
    make_records(records, views=2)
    vgg = made_vgg(weights / "vgg.pth", "VGG-16")
    networks = f'[networks]\nperceptual = "{vgg}"\n'
    common = COMMON.format(data=f'"{records}"')
    for name, text in {
        "paper": 'preset = "paper"\n' + STAGE_2 + networks,
        "pixel-aligned": 'features = "pixel-aligned"\n',
        "transformer": 'features = "transformer"\n',
    }.items():
        (folder / f"{name}.toml").write_text(common + text)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc-per-node", "2", str(BROKEN_RUNS), str(folder)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    yield folder
    shutil.rmtree(folder)  # more than a gigabyte


@pytest.mark.parametrize("name", ["paper", "pixel-aligned", "transformer"])
def test_a_break_changes_nothing(runs: Path, name: str) -> None:
    whole, broken = (
        torch.load(runs / name / kind / "checkpoint.pt", weights_only=True, mmap=True)
        for kind in ("whole", "broken")
    )
    assert whole["step"] == broken["step"] == 2
    assert whole.keys() == broken.keys()
    assert ("discriminator_optimizer" in whole) == (name == "paper")
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
