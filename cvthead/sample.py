"""The portrait that ships: what the service warms up with, its page offers, and 8-bit networks of
an import are calibrated on."""

from __future__ import annotations

from pathlib import Path

SAMPLE = Path(__file__).parent / "assets" / "sample.jpg"
