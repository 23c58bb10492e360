"""A live call: capture, sending and receiving run beside each other, always on the newest frame."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from cvthead_client.driver import Send
from cvthead_client.errors import RequestTimeoutError
from cvthead_client.media import Captured, Rgb, rgb_of
from cvthead_client.session import Rendered
from cvthead_client.stream import Stream

# How long the last frames of a video may still come in after it has ended.
LAST_SECONDS = 5.0
POLL_SECONDS = 0.2
# For the answer to one frame, when frames go one by one.
ANSWER_SECONDS = 60.0


@dataclass(eq=False)
class Newest:
    """A place for one frame, the newest; waiting for it ends when the call does."""

    _frame: Captured | None = None
    _ended: bool = False
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def put(self, frame: Captured) -> None:
        with self._changed:
            self._frame = frame
            self._changed.notify_all()

    def end(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def take(self) -> Captured | None:
        """None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._frame is not None or self._ended)
            frame, self._frame = self._frame, None
            return frame


class Call:
    """Frames in, rendered frames out, until the source or the stream ends or :meth:`stop`.

    Args:
        shown: is called in the receiving thread with every rendered frame and its capture time.
    """

    def __init__(
        self,
        frames: Iterator[Captured],
        send: Send,
        stream: Stream,
        shown: Callable[[Rgb, float], None],
    ) -> None:
        self._frames, self._send, self._stream, self._shown = frames, send, stream, shown
        self._slot = Newest()
        self._stopping = threading.Event()
        self._begin = time.monotonic()
        self._sent = self._received = -1
        self._exhausted = False
        self._times: list[float] = []
        self._latency = 0.0
        self.lost_face = 0
        self.failure: Exception | None = None
        jobs = (self._capture, self._forward, self._receive)
        self._threads = [
            threading.Thread(target=self._guarded, args=(job,), daemon=True) for job in jobs
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End the call; also from another thread."""
        self._stopping.set()
        self._slot.end()

    @property
    def over(self) -> bool:
        return self._stopping.is_set()

    def wait(self) -> None:
        """Until the call is over and nothing is written any more.

        Raises:
            CVTHeadClientError: what ended it.
        """
        while not self._stopping.wait(POLL_SECONDS):  # a plain wait would keep Ctrl-C out
            pass
        # The camera's thread may hang in the driver; it ends with the process.
        for thread in self._threads[1:]:
            thread.join(2 * LAST_SECONDS)
        if self.failure is not None:
            raise self.failure

    def summary(self) -> str:
        """Frame rate, latency and counts so far."""
        recent = [t for t in self._times[-60:] if t > time.monotonic() - 2]
        stats = self._stream.stats
        lost = self.lost_face + stats.lost_face
        return (
            f"{len(recent) / 2:.0f} frames/s, {self._latency * 1000:.0f} ms, "
            f"{stats.dropped} dropped, {lost} without a face"
        )

    def _guarded(self, job: Callable[[], None]) -> None:
        try:
            job()
        except Exception as error:
            # A stream that is closed because the call ends is no failure.
            if not self.over:
                self.failure = self.failure or error
                self.stop()

    def _capture(self) -> None:
        for frame in self._frames:
            ahead = frame.time - (time.monotonic() - self._begin)
            # A file is read faster than it plays.
            if self._stopping.wait(max(0.0, ahead)):
                return
            self._slot.put(frame._replace(time=time.monotonic() - self._begin))
        self._exhausted = True
        self._slot.end()

    def _forward(self) -> None:
        while (frame := self._slot.take()) is not None and not self.over:
            sequence = self._send(frame)
            if sequence is None:
                self.lost_face += 1
            else:
                self._sent = sequence
        deadline = time.monotonic() + LAST_SECONDS
        while self._exhausted and self._received < self._sent and time.monotonic() < deadline:
            if self._stopping.wait(POLL_SECONDS):
                return
        self.stop()

    def _receive(self) -> None:
        while not self.over:
            try:
                reply = self._stream.receive(POLL_SECONDS)
            except RequestTimeoutError:
                continue
            if not isinstance(reply, Rendered):
                # Its last frame may have shown no face.
                self._received = max(self._received, reply.sequence)
                continue
            captured = reply.capture_time / 1e6
            self._shown(rgb_of(reply.data), captured)
            now = time.monotonic()
            self._times = [*self._times[-99:], now]
            self._latency = now - self._begin - captured
            self._received = max(self._received, reply.sequence)


def step_by_step(
    frames: Iterator[Captured], send: Send, stream: Stream, write: Callable[[Rgb, float], None]
) -> int:
    """Every frame of a video, one after the other, so that none is dropped.

    Where no face is found the latest picture is repeated.

    Returns:
        Frames without a face.
    """
    lost = 0
    latest: Rgb | None = None
    for frame in frames:
        image = _answer(frame, send, stream)
        lost += image is None
        latest = latest if image is None else image
        if latest is not None:
            write(latest, frame.time)
    return lost


def _answer(frame: Captured, send: Send, stream: Stream) -> Rgb | None:
    """The rendered frame, None without a face; a frame that was refused is sent again."""
    while (sequence := send(frame)) is not None:
        before = stream.stats
        while True:
            reply = stream.receive(ANSWER_SECONDS)
            if isinstance(reply, Rendered):
                if reply.sequence == sequence:
                    return rgb_of(reply.data)
            elif reply.stats.lost_face > before.lost_face:
                return None
            elif reply.stats.dropped > before.dropped:
                break
    return None
