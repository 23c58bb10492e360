"""The resident set of the server's process, by its own metrics."""

from __future__ import annotations

import re

import httpx

GROWTH = 0.02


def resident(client: httpx.Client) -> float:
    """Bytes."""
    found = re.search(r"^process_resident_memory_bytes (\S+)", client.get("/metrics").text, re.M)
    assert found, "no resident set in /metrics; this check needs Linux"
    return float(found[1])
