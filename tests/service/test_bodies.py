"""JSON bodies are read without holding the event loop up."""

from __future__ import annotations

import asyncio
import json

import pytest
from starlette.requests import Request
from starlette.types import Message

from service.bodies import SMALL_JSON, read_json
from service.schemas import BatchRequest


def request_of(body: bytes) -> Request:
    async def receive() -> Message:
        return {"type": "http.request", "body": body, "more_body": False}

    headers = [(b"content-type", b"application/json")]
    return Request({"type": "http", "method": "POST", "headers": headers}, receive)


async def turns_while_reading(body: bytes) -> int:
    """How often the loop comes round until the body is read."""
    reading = asyncio.create_task(read_json(request_of(body), BatchRequest, 2**23))
    turns = 0
    while not reading.done():
        await asyncio.sleep(0)
        turns += 1
    await reading
    return turns


@pytest.mark.parametrize(("frames", "held"), [(1, True), (1000, False)])
def test_the_loop_goes_on_while_a_large_body_is_parsed(frames: int, held: bool) -> None:
    frame = {"shape": [0.123456] * 100, "expression": [0.123456] * 50}
    body = json.dumps({"frames": [frame] * frames}).encode()
    assert (len(body) <= SMALL_JSON) is held
    turns = asyncio.run(turns_while_reading(body))
    assert (turns <= 3) is held  # in the loop itself: begun, read, done
