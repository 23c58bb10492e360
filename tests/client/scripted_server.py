"""An HTTP server that answers what a test has written down, for what a real one cannot be made
to do at will."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass(frozen=True)
class Reply:
    """``status`` 0 cuts the connection, a negative one never answers."""

    status: int
    body: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Request:
    method: str
    path: str
    headers: dict[str, str]
    body: bytes


@dataclass(eq=False)
class Scripted:
    url: str
    requests: list[Request]


def problem(code: str, status: int, retry_after: str | None = None) -> Reply:
    document = {"code": code, "detail": f"about {code}", "hint": "a hint", "request_id": "r1"}
    headers = {"Content-Type": "application/problem+json"}
    if retry_after is not None:
        headers["Retry-After"] = retry_after
    return Reply(status, json.dumps(document).encode(), headers)


@contextmanager
def scripted(*replies: Reply) -> Iterator[Scripted]:
    """Serves the replies in order; the last one again and again."""
    requests: list[Request] = []
    over = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def answer(self) -> None:
            length = int(self.headers.get("Content-Length", 0))
            reply = replies[min(len(requests), len(replies) - 1)]
            requests.append(
                Request(self.command, self.path, dict(self.headers), self.rfile.read(length))
            )
            if reply.status <= 0:
                if reply.status < 0:
                    over.wait(30)
                self.close_connection = True
                return
            self.send_response(reply.status)
            for name, value in reply.headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(reply.body)))
            self.end_headers()
            self.wfile.write(reply.body)

        do_GET = do_POST = do_DELETE = answer  # noqa: N815

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    try:
        yield Scripted(f"http://127.0.0.1:{server.server_port}", requests)
    finally:
        over.set()
        server.shutdown()
        thread.join()
        server.server_close()
