"""One stream: take the newest frame, render it, send it, as long as the client keeps up.

Three tasks: the reader empties the socket into the mailbox, the worker renders from the mailbox
while the window has room, the reporter sends counts and looks whether the avatar still exists.
A reader that does not keep up costs one waiting frame and the window, however long it lasts.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

from cvthead_client import wire
from cvthead_client.errors import WireError
from cvthead_client.hello import CODECS, Hello
from cvthead_client.wire import Codec, Kind, Message, Stats
from fastapi import WebSocket, WebSocketDisconnect

from cvthead.composite import background
from cvthead.errors import FaceError
from cvthead.preset import AnyAvatar
from service.engine import Output, RenderJob
from service.mailbox import Mailbox, Window
from service.motion import Motion
from service.problems import Problem
from service.state import Service

REPORT_SECONDS = 1.0
FINISH_SECONDS = 2.0
# A stream that the service could not serve for so long is ended, so that its client can go
# elsewhere; until then frames are dropped as if a newer one had come.
OVERLOAD_SECONDS = 5.0
OVERLOAD_PAUSE = 0.1


@dataclass(eq=False)
class Session:
    """A stream after its hello."""

    service: Service
    socket: WebSocket
    owner: str
    avatar_id: str
    avatar: AnyAvatar
    hello: Hello
    stats: Stats = field(default_factory=Stats)
    # The newest frame that the counts include.
    handled: int = 0

    def __post_init__(self) -> None:
        self._mailbox = Mailbox()
        self._window = Window(self.hello.window)
        self._motion = Motion(self.service.engine, self.avatar, self.hello)
        self._output = output_of(self.hello)
        self._sending = asyncio.Lock()
        self._working = asyncio.Lock()

    async def run(self) -> None:
        """Serve until the client leaves or the service stops.

        Raises:
            WireError, CVTHeadError, Problem: why the stream cannot go on.
        """
        coroutines = (self._read(), self._work(), self._report(), self.service.stopping.wait())
        tasks = [asyncio.ensure_future(coroutine) for coroutine in coroutines]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if self.service.draining:
                # The frame in hand is still sent, if the client takes it.
                with suppress(TimeoutError):
                    async with asyncio.timeout(FINISH_SECONDS), self._working:
                        pass
        finally:
            for task in tasks:
                task.cancel()
            # Cancelling the worker takes its render out of the queue.
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            task.result()
        if self.service.draining:
            raise Problem("draining")

    async def _read(self) -> None:
        """Ends when the client leaves."""
        while True:
            event = await self.socket.receive()
            if event["type"] == "websocket.disconnect":
                return
            data = event.get("bytes")
            if data is None:
                raise WireError("a text message after the hello")
            message = wire.unpack(data, wire.FROM_CLIENT)
            if message.kind is Kind.ACK:
                self._window.acknowledge(message.sequence)
                continue
            self._count("received")
            if self._mailbox.put(message):
                self._count("dropped")

    async def _work(self) -> None:
        refused_since: float | None = None
        while True:
            await self._window.room()
            message = await self._mailbox.take()
            self.handled = message.sequence
            try:
                async with self._working:
                    await self._render(message)
                refused_since = None
            except FaceError:
                # The client shows the last frame on; it learns why nothing new comes.
                self._count("lost_face")
                await self._send_stats()
            except Problem as problem:
                if problem.code != "overloaded":
                    raise
                self._count("dropped")
                refused_since = refused_since or time.monotonic()
                if time.monotonic() - refused_since > OVERLOAD_SECONDS:
                    raise
                await asyncio.sleep(OVERLOAD_PAUSE)

    async def _render(self, message: Message) -> None:
        wanted = await self._motion.of(message)
        job = RenderJob(self.avatar, wanted, self._output)
        rendered = await self.service.engine.render(job)
        codec = CODECS[self.hello.output.codec]
        reply = Message(Kind.RENDERED, codec, message.sequence, message.capture_time, rendered.data)
        self._window.sent(message.sequence)
        await self._send(reply)
        self._count("rendered")

    async def _report(self) -> None:
        reported = self.stats
        while True:
            await asyncio.sleep(REPORT_SECONDS)
            # Deleted, expired or another owner's: the stream must not outlive it.
            await asyncio.to_thread(self.service.cache.record, self.avatar_id, owner=self.owner)
            if self.stats != reported:
                reported = self.stats
                await self._send_stats()

    async def _send_stats(self) -> None:
        payload = wire.pack_stats(self.stats)
        await self._send(Message(Kind.STATS, Codec.NONE, self.handled, 0, payload))

    async def _send(self, message: Message) -> None:
        async with self._sending:
            try:
                await self.socket.send_bytes(wire.pack(message))
            except (WebSocketDisconnect, RuntimeError):
                # The client has left; the reader notices it, too, and ends the stream.
                await asyncio.Event().wait()

    def _count(self, event: str) -> None:
        self.stats = replace(self.stats, **{event: getattr(self.stats, event) + 1})
        self.service.metrics.stream_frames.labels(event).inc()


def output_of(hello: Hello) -> Output:
    """The engine's output for a hello."""
    wanted = hello.output
    return Output(wanted.size, background(wanted.background), wanted.codec, wanted.quality)


# WebSocket close codes by the code of the problem; others are 1008, policy violation.
CLOSE_CODES: Mapping[str, int] = {
    "draining": 1001,
    "body_too_large": 1009,
    "image_too_large": 1009,
    "internal": 1011,
    "overloaded": 1013,
    "rate_limited": 1013,
    "not_ready": 1013,
    "avatar_not_found": 4404,
    "model_changed": 4409,
    "avatar_expired": 4410,
    "invalid_avatar_file": 4410,
}
POLICY_VIOLATION = 1008
