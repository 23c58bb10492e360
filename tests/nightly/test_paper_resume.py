"""The paper's network with its adversary goes on from a checkpoint as if nothing had happened.

    scripts/nightly -k paper

Its checkpoints hold more than a gigabyte, which takes minutes; tests/test_training_resume.py
does the same with the open preset's networks.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from made_loss_networks import made_vgg
from resumed import assert_a_break_changed_nothing, run_with_breaks

pytestmark = pytest.mark.nightly

PAPER = """\
preset = "paper"
stage = 2
[losses]
adversarial = 0.1
feature_matching = 1.0
[networks]
perceptual = "{vgg}"
"""


def test_a_break_changes_nothing(tmp_path: Path) -> None:
    vgg = made_vgg(tmp_path / "vgg.pth", "VGG-16")
    run_with_breaks(tmp_path, {"paper": PAPER.format(vgg=vgg)})
    assert_a_break_changed_nothing(tmp_path / "paper", adversary=True)
    shutil.rmtree(tmp_path / "paper")
