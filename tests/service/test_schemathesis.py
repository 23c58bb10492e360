"""Requests made from the OpenAPI document: none may end in a 500, all as documented."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from server_process import Server

pytest.importorskip("schemathesis", reason="these tests need the package schemathesis")
from schemathesis import APIOperation, Case, GenerationMode, checks, openapi

EXAMPLES = 10
# What is checked of every answer. Whether made-up data is accepted is not: no random bytes show
# a face.
CHECKS = [
    checks.not_a_server_error,
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_schema_conformance,
    checks.response_headers_conformance,
]
Operation = APIOperation[Any, Any, Any, Any]
RENDER = "POST /v1/avatars/{avatar_id}/render"


def test_answers_are_as_documented(
    server: Server, avatar_id: str, subtests: pytest.Subtests
) -> None:
    schema = openapi.from_url(f"{server.url}/openapi.json")
    operations: list[Operation] = [result.ok() for result in schema.get_all_operations()]  # type: ignore[union-attr]
    seen: dict[str, set[int]] = {operation.label: set() for operation in operations}
    for operation in operations:
        for mode in GenerationMode:
            # Without parameters and body there is nothing to get wrong.
            if mode is GenerationMode.POSITIVE or [*operation.iter_parameters(), *operation.body]:
                with subtests.test(operation=operation.label, data=mode.value):
                    seen[operation.label] |= _statuses(operation, mode, avatar_id)
    # The requests get further than to an unknown id.
    assert {200, 404, 422} <= seen[RENDER]


def _statuses(operation: Operation, mode: GenerationMode, avatar_id: str) -> set[int]:
    """Send requests made from one operation's description, every second to a real avatar."""
    seen: list[int] = []

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy(generation_mode=mode))
    def answers(case: Case[Any]) -> None:
        if len(seen) % 2 == 0 and "avatar_id" in case.path_parameters and case.method != "DELETE":
            case.path_parameters["avatar_id"] = avatar_id
        seen.append(case.call_and_validate(checks=CHECKS).status_code)

    answers()
    return set(seen)
