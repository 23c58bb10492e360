"""The stream: send coefficients or driving frames, take rendered frames; async and blocking.

A frame is acknowledged when it is handed to the caller, so a caller that stops taking frames
stops the service from rendering more than the window; it then always works on the newest one.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager, suppress

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConcurrencyError, ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection as SyncConnection
from websockets.sync.client import connect as connect_sync

from cvthead_client.errors import CVTHeadClientError, RequestTimeoutError, StreamClosedError
from cvthead_client.hello import Hello, Welcome
from cvthead_client.session import (
    MAX_MESSAGE,
    NORMAL_CLOSURE,
    Rendered,
    Report,
    Session,
    acknowledgement,
    closed_error,
    handshake_error,
    stream_url,
    welcome_of,
)
from cvthead_client.wire import CoefficientFrame, Stats


class AsyncStream:
    """An open stream. One task may send while another receives.

    Iterating gives the rendered frames until the stream is closed normally; any other end raises
    the error that says why.
    """

    def __init__(self, connection: ClientConnection, welcome: Welcome) -> None:
        self._connection = connection
        self._session = Session(welcome)

    @property
    def welcome(self) -> Welcome:
        """What the service granted."""
        return self._session.welcome

    @property
    def stats(self) -> Stats:
        """The latest counts that were received."""
        return self._session.stats

    async def send_coefficients(
        self, frame: CoefficientFrame, *, capture_time: int | None = None
    ) -> int:
        """Ask for a frame with these coefficients.

        Args:
            capture_time: microseconds on any clock; comes back with the rendered frame.

        Returns:
            The frame's sequence number.
        """
        sequence, data = self._session.coefficients(frame, capture_time)
        await self._send(data)
        return sequence

    async def send_picture(
        self, data: bytes, *, capture_time: int | None = None, reference: bool = False
    ) -> int:
        """Ask for a frame that is driven by the face in a JPEG, PNG or WebP file.

        Args:
            reference: relative motion is measured from this frame on.
        """
        sequence, message = self._session.picture(data, capture_time, reference=reference)
        await self._send(message)
        return sequence

    async def receive(self) -> Rendered | Report:
        """The service's next message; a rendered frame is acknowledged.

        Raises:
            StreamClosedError: with close code 1000 after a normal end.
            ServiceError: the service ended the stream and said why.
        """
        try:
            reply = self._session.read(await self._connection.recv())
        except ConnectionClosed as closed:
            raise _ended(closed) from closed
        if isinstance(reply, Rendered):
            with suppress(ConnectionClosed):  # the next call says why
                await self._connection.send(acknowledgement(reply))
        return reply

    async def __aiter__(self) -> AsyncIterator[Rendered]:
        while True:
            try:
                reply = await self.receive()
            except StreamClosedError as closed:
                if closed.close_code == NORMAL_CLOSURE:
                    return
                raise
            if isinstance(reply, Rendered):
                yield reply

    async def close(self) -> None:
        await self._connection.close()

    async def _send(self, data: bytes) -> None:
        try:
            await self._connection.send(data)
        except ConnectionClosed as closed:
            # The reason may wait among the messages that were received before the end, unless
            # another task takes them.
            try:
                while True:
                    self._session.read(await self._connection.recv())
            except (ConnectionClosed, ConcurrencyError):
                raise _ended(closed) from closed


@asynccontextmanager
async def open_async_stream(
    server: str, avatar_id: str, hello: Hello, headers: Mapping[str, str], *, timeout: float
) -> AsyncIterator[AsyncStream]:
    """Connect and shake hands; close at the end of the block.

    Raises:
        TransportError, ServiceError, WireError: why there is no stream.
    """
    connecting = connect(
        stream_url(server, avatar_id),
        additional_headers=headers,
        compression=None,  # wasted on pictures
        max_size=MAX_MESSAGE,
        open_timeout=timeout,
    )
    async with AsyncExitStack() as stack:
        try:
            connection = await stack.enter_async_context(connecting)
            # A service that refused has closed already; why is its first message.
            with suppress(ConnectionClosed):
                await connection.send(hello.to_json())
            async with asyncio.timeout(timeout):
                first = await connection.recv()
        except ConnectionClosed as closed:
            raise _ended(closed) from closed
        except (OSError, WebSocketException) as error:  # TimeoutError is an OSError
            raise handshake_error(error, server) from error
        yield AsyncStream(connection, welcome_of(first))


class Stream:
    """As :class:`AsyncStream`, blocking. One thread may send while another receives."""

    def __init__(self, connection: SyncConnection, welcome: Welcome) -> None:
        self._connection = connection
        self._session = Session(welcome)

    @property
    def welcome(self) -> Welcome:
        """What the service granted."""
        return self._session.welcome

    @property
    def stats(self) -> Stats:
        """The latest counts that were received."""
        return self._session.stats

    def send_coefficients(self, frame: CoefficientFrame, *, capture_time: int | None = None) -> int:
        """As :meth:`AsyncStream.send_coefficients`."""
        sequence, data = self._session.coefficients(frame, capture_time)
        self._send(data)
        return sequence

    def send_picture(
        self, data: bytes, *, capture_time: int | None = None, reference: bool = False
    ) -> int:
        """As :meth:`AsyncStream.send_picture`."""
        sequence, message = self._session.picture(data, capture_time, reference=reference)
        self._send(message)
        return sequence

    def receive(self, timeout: float | None = None) -> Rendered | Report:
        """As :meth:`AsyncStream.receive`.

        Args:
            timeout: seconds; None waits for ever.

        Raises:
            RequestTimeoutError: nothing came in time; the stream stays open.
        """
        try:
            reply = self._session.read(self._connection.recv(timeout))
        except TimeoutError as error:
            raise RequestTimeoutError("no message came in time", hint="receive again") from error
        except ConnectionClosed as closed:
            raise _ended(closed) from closed
        if isinstance(reply, Rendered):
            with suppress(ConnectionClosed):
                self._connection.send(acknowledgement(reply))
        return reply

    def __iter__(self) -> Iterator[Rendered]:
        while True:
            try:
                reply = self.receive()
            except StreamClosedError as closed:
                if closed.close_code == NORMAL_CLOSURE:
                    return
                raise
            if isinstance(reply, Rendered):
                yield reply

    def close(self) -> None:
        self._connection.close()

    def _send(self, data: bytes) -> None:
        try:
            self._connection.send(data)
        except ConnectionClosed as closed:
            try:
                while True:
                    self._session.read(self._connection.recv())
            except (ConnectionClosed, ConcurrencyError):
                raise _ended(closed) from closed


@contextmanager
def open_stream(
    server: str, avatar_id: str, hello: Hello, headers: Mapping[str, str], *, timeout: float
) -> Iterator[Stream]:
    """As :func:`open_async_stream`, blocking."""
    with ExitStack() as stack:
        try:
            connection = stack.enter_context(
                connect_sync(
                    stream_url(server, avatar_id),
                    additional_headers=headers,
                    compression=None,
                    max_size=MAX_MESSAGE,
                    open_timeout=timeout,
                )
            )
            with suppress(ConnectionClosed):
                connection.send(hello.to_json())
            first = connection.recv(timeout)
        except ConnectionClosed as closed:
            raise _ended(closed) from closed
        except (OSError, WebSocketException) as error:
            raise handshake_error(error, server) from error
        yield Stream(connection, welcome_of(first))


def _ended(closed: ConnectionClosed) -> CVTHeadClientError:
    return closed_error(closed) or StreamClosedError(
        "the stream was closed", hint="open a new stream", close_code=NORMAL_CLOSURE
    )
