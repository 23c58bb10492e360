"""Which threads of a running service have a lowered priority."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from server_process import Server

from cvthead.runtime.networks import MAX_THREADS
from cvthead.runtime.threads import cores
from service.app import ENCODE_NICENESS

MAX_NICENESS = 19


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of threads are Linux's")
def test_encoding_and_its_helpers_are_lowered_and_nothing_else(
    server: Server, avatar_id: str
) -> None:
    """After an upload: all threads that encoding uses are there."""
    process = Path("/proc", str(server.process.pid))
    own = niceness(process / "stat")
    if own == MAX_NICENESS:
        pytest.skip("the tests themselves run at the lowest priority")
    lowered = min(own + ENCODE_NICENESS, MAX_NICENESS)
    found = [niceness(thread / "stat") for thread in (process / "task").iterdir()]
    helpers = min(MAX_THREADS, cores()) - 1
    assert found.count(lowered) == 1 + helpers
    assert found.count(own) == len(found) - 1 - helpers
    assert found.count(own) >= 2 + helpers  # event loop, renders and the painter's helpers


def niceness(stat: Path) -> int:
    """proc_pid_stat(5), field 19; the name before field 3 can have blanks."""
    return int(stat.read_text().rpartition(")")[2].split()[16])
