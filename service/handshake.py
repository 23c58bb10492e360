"""The WebSocket handshake: uvicorn's, but what it refuses is answered as a problem."""

from __future__ import annotations

import secrets
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidHandshake, InvalidMessage, InvalidMethod
from websockets.http11 import Request

from service.problems import Problem
from service.protocol import last_answer

HINT = "Let a WebSocket library open the stream."
VERSION = {"Sec-WebSocket-Version": "13"}  # RFC 6455, section 4.4


class Handshake(WebSocketsSansIOProtocol):
    """Refuses handshakes that are not as RFC 6455 has them, before an application is called.

    uvicorn alone answers in plain text, or, when the headers are too large for the WebSocket
    library, not at all.
    """

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        error = self.conn.handshake_exc
        if error is not None and not self.handshake_initiated and not self.close_sent:
            code = "malformed_request" if isinstance(error, InvalidMessage) else "headers_too_large"
            self._refuse(Problem(code, f"the WebSocket handshake is wrong: {error}"), "")

    def handle_connect(self, event: Request) -> None:
        try:
            self.conn.process_request(event)
        except InvalidMethod:
            headers = {"Allow": "GET"}
            self._refuse(Problem("method_not_allowed", hint=HINT, headers=headers), event.path)
        except InvalidHandshake as error:
            detail = f"the WebSocket handshake is wrong: {error}"
            problem = Problem("malformed_request", detail, hint=HINT, headers=VERSION)
            self._refuse(problem, event.path)
        else:
            super().handle_connect(event)

    async def send(self, message: Any) -> None:
        await super().send(message)
        # An application's refusal, too, completes it; uvicorn would log that nothing was answered.
        self.handshake_complete = self.handshake_complete or self.close_sent

    def _refuse(self, problem: Problem, path: str) -> None:
        self.handshake_complete = self.close_sent = True
        instance = path.partition("?")[0]
        self.transport.write(last_answer(problem, instance, secrets.token_hex(8)))
        self.transport.close()
