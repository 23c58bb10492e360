"""Newest frame wins, and no more than the window is under way."""

from __future__ import annotations

import asyncio

import pytest
from cvthead_client.wire import Codec, Kind, Message

from service.mailbox import Mailbox, Window


def frame(sequence: int, kind: Kind = Kind.DRIVING) -> Message:
    return Message(kind, Codec.JPEG, sequence, 0, b"\xff\xd8\xff")


def test_newest_frame_wins() -> None:
    async def scenario() -> None:
        mailbox = Mailbox()
        assert [mailbox.put(frame(number)) for number in range(4)] == [False, True, True, True]
        assert (await mailbox.take()).sequence == 3
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(mailbox.take(), 0.01)

    asyncio.run(scenario())


def test_a_reference_is_not_pushed_out() -> None:
    async def scenario() -> None:
        mailbox = Mailbox()
        assert not mailbox.put(frame(0, Kind.REFERENCE))
        assert not mailbox.put(frame(1))
        assert mailbox.put(frame(2))
        assert mailbox.put(frame(3, Kind.REFERENCE))
        assert [(await mailbox.take()).sequence for _ in range(2)] == [3, 2]

    asyncio.run(scenario())


def test_take_waits_for_a_frame() -> None:
    async def scenario() -> None:
        mailbox = Mailbox()
        taking = asyncio.create_task(mailbox.take())
        await asyncio.sleep(0)
        mailbox.put(frame(7))
        assert (await taking).sequence == 7

    asyncio.run(scenario())


def test_window_is_respected() -> None:
    async def scenario() -> None:
        window = Window(2)
        for sequence in (10, 11):
            await window.room()
            window.sent(sequence)
        waiting = asyncio.create_task(window.room())
        await asyncio.sleep(0)
        for unknown in (9, 12, 2**32 - 1):
            window.acknowledge(unknown)
            await asyncio.sleep(0)
            assert not waiting.done()
        window.acknowledge(10)
        await waiting
        window.sent(12)
        # The newest shown: what was sent before it counts as shown, too.
        window.acknowledge(12)
        for sequence in (13, 14):
            await window.room()
            window.sent(sequence)

    asyncio.run(scenario())
