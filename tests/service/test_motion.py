"""What a stream's frames cost the event loop."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass, field
from typing import Any

import pytest
from cvthead_client import wire
from cvthead_client.hello import Hello
from cvthead_client.wire import Codec, Kind, Message
from raw_stream import coefficients
from server_process import PORTRAIT

from cvthead.avatar import Avatar
from cvthead.controls import Controls
from cvthead.pipeline import Pipeline
from service.engine import Engine
from service.metrics import Metrics
from service.motion import Motion


@dataclass
class Watched:
    """An avatar that notes which threads look at it."""

    avatar: Avatar
    threads: set[threading.Thread] = field(default_factory=set)

    def __getattr__(self, name: str) -> Any:
        self.threads.add(threading.current_thread())
        return getattr(self.avatar, name)


@pytest.mark.parametrize("camera", ["source", "driver"])
def test_driving_frames_are_not_solved_in_the_event_loop(
    pipeline: Pipeline, avatar: Avatar, camera: str
) -> None:
    watched = Watched(avatar)
    picture = PORTRAIT.read_bytes()
    hello = Hello(camera=camera)  # type: ignore[arg-type]

    async def work() -> None:
        engine = Engine(pipeline, Metrics(), encode_queue=1, render_queue=4, max_batch=1)
        await engine.start()
        motion = Motion(engine, watched, hello)
        for kind in (Kind.REFERENCE, Kind.DRIVING):
            message = Message(kind, wire.sniff(picture), 1, 0, picture)
            assert not isinstance(await motion.of(message), Controls)
        assert watched.threads
        assert threading.main_thread() not in watched.threads
        numbers = Message(
            Kind.COEFFICIENTS, Codec.NONE, 2, 0, wire.pack_coefficients(coefficients())
        )
        with pytest.raises(StopIteration):  # no thread, nothing to wait for
            motion.of(numbers).send(None)
        await engine.stop(30)

    asyncio.run(work())
