"""How a stream stays live and small: one waiting frame, few unacknowledged ones."""

from __future__ import annotations

import asyncio
from collections import deque

from cvthead_client.wire import Kind, Message


class Mailbox:
    """Holds the newest driving frame; an older one that still waits is thrown away.

    A reference frame has a place of its own, so that the frames after it do not push it out.
    """

    def __init__(self) -> None:
        self._reference: Message | None = None
        self._frame: Message | None = None
        self._filled = asyncio.Event()

    def put(self, message: Message) -> bool:
        """Leave a frame; whether it replaced one."""
        if message.kind is Kind.REFERENCE:
            replaced, self._reference = self._reference, message
        else:
            replaced, self._frame = self._frame, message
        self._filled.set()
        return replaced is not None

    async def take(self) -> Message:
        """Wait for a frame; the reference comes first."""
        await self._filled.wait()
        message = self._reference or self._frame
        assert message is not None
        if message is self._reference:
            self._reference = None
        else:
            self._frame = None
        if self._reference is None and self._frame is None:
            self._filled.clear()
        return message


class Window:
    """Rendered frames that the client has not acknowledged yet.

    Socket buffers take many frames before a slow reader can be felt; acknowledgements tell at once.

    Args:
        size: how many there may be.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._sent: deque[int] = deque()
        self._changed = asyncio.Event()

    async def room(self) -> None:
        """Wait until one more frame may be sent."""
        while len(self._sent) >= self._size:
            self._changed.clear()
            await self._changed.wait()

    def sent(self, sequence: int) -> None:
        self._sent.append(sequence)

    def acknowledge(self, sequence: int) -> None:
        """A frame was shown: it and those sent before it are done. Unknown ones change nothing."""
        if sequence in self._sent:
            while self._sent.popleft() != sequence:
                pass
            self._changed.set()
