"""How much the nightly checks do."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(scope="session")
def part() -> float:
    """Which part of the full number of repetitions to do, 0..1."""
    return float(os.environ.get("NIGHTLY_PART", "1"))
