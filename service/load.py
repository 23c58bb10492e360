"""``python -m service.load``: how many renders per second a running service gives, and how fast.

Closed loop: every client sends its next render as soon as it has the answer to the last one.
Threads with plain sockets and httptools take a fraction of the time per request that
``http.client`` or an asynchronous client needs, so the figures are the service's.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import re
import socket
import ssl
import statistics
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httptools

MODEL_STAGES = ("pose", "paint")
ALLOWED_MS, ALLOWED_SHARE = 3.0, 0.1  # what may be added to the model's time at one client
TIMEOUT = 60.0
WARM_UP = 3
TIMING = re.compile(r"([\w-]+);(?:[^,]*;)?dur=([\d.]+)")


class LoadError(Exception):
    """The service cannot be reached, or refuses the upload."""


@dataclass(frozen=True)
class Answer:
    """One render: status, milliseconds until the last byte, milliseconds by stage."""

    status: int
    milliseconds: float
    stages: dict[str, float]

    @property
    def model(self) -> float:
        """Milliseconds in the head model, splat and U-Net."""
        return sum(self.stages.get(stage, 0.0) for stage in MODEL_STAGES)


@dataclass(frozen=True)
class Row:
    """What a number of clients saw in ``seconds``."""

    clients: int
    seconds: float
    answers: tuple[Answer, ...]

    @property
    def rendered(self) -> list[Answer]:
        return [answer for answer in self.answers if answer.status == 200]

    @property
    def per_second(self) -> float:
        return len(self.rendered) / self.seconds

    def percentile(self, percent: float) -> float:
        """Nearest-rank percentile of the latencies, milliseconds."""
        times = sorted(answer.milliseconds for answer in self.rendered)
        return times[max(0, math.ceil(len(times) * percent / 100) - 1)]

    @property
    def model(self) -> float:
        return statistics.median(answer.model for answer in self.rendered)

    @property
    def outside(self) -> float:
        """Median milliseconds outside the model: HTTP, queue, compositing, PNG."""
        return statistics.median(a.milliseconds - a.model for a in self.rendered)

    @property
    def share(self) -> float:
        """Part of all time that was spent outside the model, 0..1."""
        whole = sum(answer.milliseconds for answer in self.rendered)
        return 1 - sum(answer.model for answer in self.rendered) / whole


class _Response:
    """What httptools reports of one response."""

    def __init__(self) -> None:
        self.body = b""
        self.timing = ""
        self.complete = False

    def on_header(self, name: bytes, value: bytes) -> None:
        if name.lower() == b"server-timing":
            self.timing = value.decode("latin-1")

    def on_body(self, body: bytes) -> None:
        self.body += body

    def on_message_complete(self) -> None:
        self.complete = True


class Target:
    """One kept-alive connection to the service."""

    def __init__(self, url: str, key: str) -> None:
        parts = urlsplit(url)
        secure = parts.scheme == "https"
        host, port = parts.hostname or "127.0.0.1", parts.port or (443 if secure else 80)
        self._socket = socket.create_connection((host, port), TIMEOUT)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if secure:
            context = ssl.create_default_context()
            self._socket = context.wrap_socket(self._socket, server_hostname=host)
        self._headers = {"Host": parts.netloc}
        if key:
            self._headers["Authorization"] = f"Bearer {key}"

    def send(
        self, method: str, path: str, body: bytes = b"", **headers: str
    ) -> tuple[int, bytes, str]:
        """Status, body and Server-Timing of one request.

        Raises:
            LoadError: the answer is not HTTP, or ends too early.
        """
        fields = self._headers | {"Content-Length": str(len(body))}
        fields |= {name.replace("_", "-"): value for name, value in headers.items()}
        lines = [f"{method} {path} HTTP/1.1", *(f"{n}: {v}" for n, v in fields.items()), "", ""]
        self._socket.sendall("\r\n".join(lines).encode("latin-1") + body)
        response = _Response()
        parser = httptools.HttpResponseParser(response)
        try:
            while not response.complete:
                data = self._socket.recv(2**18)
                if not data:
                    raise LoadError("the service closed the connection")
                parser.feed_data(data)
        except httptools.HttpParserError as error:
            raise LoadError(f"the answer is not HTTP: {error}") from error
        return parser.get_status_code(), response.body, response.timing

    def close(self) -> None:
        self._socket.close()


def upload(target: Target, portrait: Path) -> str:
    """Path of a new avatar."""
    status, body, _ = target.send(
        "POST",
        "/v1/avatars?consent=true&lifetime=3600",
        portrait.read_bytes(),
        Content_Type="application/octet-stream",
    )
    if status != 201:
        raise LoadError(f"the upload of {portrait} was answered {status}: {body[:300].decode()}")
    return f"/v1/avatars/{json.loads(body)['id']}"


def render(target: Target, avatar: str, chance: random.Random, accept: str, size: int) -> Answer:
    """Render one random pose and smile, so that no answer can come from a cache."""
    request = {
        "mode": "relative",
        "pose": {"global": [0.0, chance.uniform(-0.4, 0.4), 0.0]},
        "arkit": {"mouthSmileLeft": chance.random(), "mouthSmileRight": chance.random()},
        "output": {"size": size, "background": "white"},
    }
    begin = time.perf_counter()
    status, _, timing = target.send(
        "POST",
        f"{avatar}/render",
        json.dumps(request).encode(),
        Content_Type="application/json",
        Accept=accept,
    )
    milliseconds = (time.perf_counter() - begin) * 1000
    stages = {name: float(duration) for name, duration in TIMING.findall(timing)}
    return Answer(status, milliseconds, stages)


def measure(args: argparse.Namespace, avatar: str, clients: int) -> Row:
    """Let ``clients`` render for ``args.seconds``."""

    def client(number: int) -> list[Answer]:
        target, chance = Target(args.url, args.key), random.Random(number)
        answers = []
        try:
            while time.perf_counter() < end:
                answers.append(render(target, avatar, chance, args.accept, args.size))
                if answers[-1].status != 200:
                    time.sleep(0.05)  # refused at once; asking again at once is no load
        finally:
            target.close()
        return answers

    begin = time.perf_counter()
    end = begin + args.seconds
    with ThreadPoolExecutor(clients) as pool:
        answers = [answer for own in pool.map(client, range(clients)) for answer in own]
    row = Row(clients, time.perf_counter() - begin, tuple(answers))
    if not row.rendered:
        seen = ", ".join(map(str, sorted({answer.status for answer in answers})))
        raise LoadError(f"no render succeeded with {clients} clients; answers: {seen}")
    return row


def table(rows: Sequence[Row]) -> str:
    """The figures as a Markdown table, and the verdict on one client."""
    lines = [
        "| clients | renders/s | p50 ms | p95 ms | p99 ms | model ms | outside ms | outside % "
        "| refused |",
        "| ---: " * 9 + "|",
    ]
    for row in rows:
        percentiles = " | ".join(f"{row.percentile(p):.1f}" for p in (50, 95, 99))
        refused = len(row.answers) - len(row.rendered)
        lines.append(
            f"| {row.clients} | {row.per_second:.1f} | {percentiles} | {row.model:.1f} "
            f"| {row.outside:.1f} | {row.share:.1%} | {refused} |"
        )
    lines += ["", *(verdict(row) for row in rows if row.clients == 1)]
    return "\n".join(lines)


def verdict(row: Row) -> str:
    """Whether what one client waits outside the model is within what is allowed."""
    allowed = max(ALLOWED_MS, ALLOWED_SHARE * row.model)
    stages = ", ".join(f"{name} {median:.1f}" for name, median in _stages(row).items())
    return (
        f"One client: {row.outside:.1f} ms beside {row.model:.1f} ms of the model, "
        f"{'within' if row.outside <= allowed else 'over'} the {allowed:.1f} ms that are allowed. "
        f"Stages, ms: {stages}."
    )


def _stages(row: Row) -> dict[str, float]:
    names = dict.fromkeys(name for answer in row.rendered for name in answer.stages)
    return {n: statistics.median(a.stages.get(n, 0.0) for a in row.rendered) for n in names}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; 0, or 2 when the service could not be measured."""
    parser = argparse.ArgumentParser(
        prog="python -m service.load",
        description="Load a running service with renders and print a table: renders per second, "
        "latency, and the time outside the model by Server-Timing.",
    )
    parser.add_argument("--url", default="http://127.0.0.1:8000", help="address of the service")
    parser.add_argument(
        "--key", default=os.environ.get("CVTHEAD_KEY", ""), help="API key (or CVTHEAD_KEY)"
    )
    parser.add_argument("--portrait", type=Path, default=Path("examples/astronaut.png"))
    parser.add_argument("--clients", type=_numbers, default=(1, 4, 16), metavar="N,N,...")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each number of clients")
    parser.add_argument("--size", type=int, default=256, help="side of the picture, pixels")
    parser.add_argument("--accept", default="image/png", help="format of the picture")
    args = parser.parse_args(argv)
    try:
        print(run(args))
    except (LoadError, OSError) as error:
        print(f"service.load: error: {args.url}: {error}", file=sys.stderr)
        return 2
    return 0


def run(args: argparse.Namespace) -> str:
    """Upload, measure with every number of clients, delete; the table."""
    target = Target(args.url, args.key)
    avatar = upload(target, args.portrait)
    try:
        for _ in range(WARM_UP):
            render(target, avatar, random.Random(0), args.accept, args.size)
        return table([measure(args, avatar, clients) for clients in args.clients])
    finally:
        target.close()  # idle for minutes: the service may have closed it
        fresh = Target(args.url, args.key)
        fresh.send("DELETE", avatar)
        fresh.close()


def _numbers(text: str) -> tuple[int, ...]:
    numbers = tuple(int(part) for part in text.split(","))
    if min(numbers) < 1:
        raise ValueError("at least one client")
    return numbers


if __name__ == "__main__":
    sys.exit(main())
