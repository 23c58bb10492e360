"""Fixtures that several test files use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """Reference data beside the repository; CVTHEAD_SHARED overrides the place."""
    default = Path(__file__).parents[2] / "shared"
    path = Path(os.environ.get("CVTHEAD_SHARED", default))
    if not path.is_dir():
        pytest.skip(f"no reference data at {path}; set CVTHEAD_SHARED")
    return path
