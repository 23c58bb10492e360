"""A problem as it comes over a socket."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from service.problem_codes import PROBLEMS


def checked_problem(lines: Sequence[str], body: bytes | str, code: str) -> dict[str, Any]:
    """The body of an answer, which is that problem and the connection's last.

    Args:
        lines: status and headers, in lower case.
    """
    assert lines[0].startswith(f"http/1.1 {PROBLEMS[code].status} ")
    assert "content-type: application/problem+json" in lines
    assert "connection: close" in lines
    said: dict[str, Any] = json.loads(body)
    assert (said["code"], said["status"]) == (code, PROBLEMS[code].status)
    assert said["hint"]
    assert said["request_id"]
    return said
