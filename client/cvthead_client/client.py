"""The blocking client."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import httpx

from cvthead_client import calls, replies
from cvthead_client.calls import Call
from cvthead_client.errors import CVTHeadClientError
from cvthead_client.files import archive_type, complete_file
from cvthead_client.hello import Hello
from cvthead_client.multipart import PartReader
from cvthead_client.replies import Retry
from cvthead_client.stream import Stream, open_stream
from cvthead_client.types import (
    AvatarInfo,
    Controls,
    Output,
    Picture,
    PictureFormat,
    Portrait,
    Tracked,
)


class Client:
    """Calls a cvthead service. Use it in a ``with`` block, or call :meth:`close`.

    Args:
        server: its address, for example "http://127.0.0.1:8000".
        key: API key, if the service has keys.
        timeout: seconds to wait for a connection or for the next bytes of an answer.
        retry: when requests are repeated.

    Every method raises the errors of ``cvthead_client.errors``: TransportError if no usable
    answer came, ServiceError if the service refused.
    """

    def __init__(
        self,
        server: str,
        *,
        key: str | None = None,
        timeout: float = 60.0,
        retry: Retry | None = None,
    ) -> None:
        self.server = calls.server_url(server)
        self.timeout = timeout
        self.retry = retry or Retry()
        self._headers = calls.headers_for(key)
        self._http = httpx.Client(base_url=self.server, headers=self._headers, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def create(
        self,
        portrait: Portrait,
        *,
        face: int | None = None,
        lifetime: float | None = None,
        consent: bool = False,
        idempotency_key: str | None = None,
    ) -> AvatarInfo:
        """Upload a portrait.

        Args:
            portrait: a file's path, or the bytes of a PNG, JPEG or WebP file.
            face: which face if there are several, 0 = largest.
            lifetime: seconds until the service forgets the avatar.
            consent: states that the person in the picture agreed.
            idempotency_key: the same key gives the same avatar; a random one by default, which
                makes the repetitions of this call safe.
        """
        call = calls.create(
            portrait,
            face=face,
            lifetime=lifetime,
            consent=consent,
            idempotency_key=idempotency_key,
        )
        return replies.read_avatar(self._send(call))

    def get(self, avatar_id: str) -> AvatarInfo:
        """An avatar's properties."""
        return replies.read_avatar(self._send(calls.get(avatar_id)))

    def list(self, *, page_size: int = 50) -> Iterator[AvatarInfo]:
        """The key's avatars, newest first; fetched page by page while it is iterated."""
        cursor: str | None = None
        while True:
            items, cursor = replies.read_page(self._send(calls.page(page_size, cursor)))
            yield from items
            if cursor is None:
                return

    def delete(self, avatar_id: str) -> None:
        """Remove an avatar for good."""
        self._send(calls.delete(avatar_id))

    def preview(self, avatar_id: str, *, picture_format: PictureFormat = "png") -> Picture:
        """The avatar in the portrait's own pose."""
        return replies.read_picture(self._send(calls.preview(avatar_id, picture_format)))

    def render(
        self,
        avatar_id: str,
        controls: Controls | None = None,
        *,
        output: Output | None = None,
        picture_format: PictureFormat = "png",
    ) -> Picture:
        """The avatar as ``controls`` ask."""
        call = calls.render(avatar_id, controls or Controls(), output or Output(), picture_format)
        return replies.read_picture(self._send(call))

    def drive(
        self,
        avatar_id: str,
        picture: Portrait,
        *,
        reference: Portrait | None = None,
        camera: Literal["source", "driver"] = "source",
        output: Output | None = None,
        picture_format: PictureFormat = "png",
    ) -> Picture:
        """The avatar with the expression and pose of the face in ``picture``.

        Args:
            reference: a picture of the driver looking as the portrait does; what is added to the
                portrait is the motion since it.
            camera: keep the portrait's, or follow place and size of the driver's head.
        """
        call = calls.drive(
            avatar_id,
            picture,
            reference=reference,
            camera=camera,
            output=output or Output(),
            picture_format=picture_format,
        )
        return replies.read_picture(self._send(call))

    def track(
        self, picture: Portrait, *, face: int | None = None, blendshapes: bool = True
    ) -> Tracked:
        """The coefficients of the face in ``picture``."""
        call = calls.track(picture, face=face, blendshapes=blendshapes)
        return replies.read_tracked(self._send(call))

    def batch(
        self,
        avatar_id: str,
        frames: Iterable[Controls],
        *,
        output: Output | None = None,
        picture_format: PictureFormat = "png",
    ) -> Iterator[Picture]:
        """One picture for each of ``frames``, in order, as soon as it is rendered."""
        call = calls.batch(
            avatar_id, frames, 25.0, output or Output(), picture_format, "multipart/mixed"
        )
        with self._streamed(call) as response:
            reader = PartReader(response.headers.get("Content-Type", ""))
            for data in response.iter_bytes():
                yield from reader.feed(data)
            reader.end()

    def batch_file(
        self,
        avatar_id: str,
        frames: Iterable[Controls],
        path: Path | str,
        *,
        fps: float = 25.0,
        output: Output | None = None,
        picture_format: PictureFormat = "png",
    ) -> None:
        """All of ``frames`` as one file: ``.zip`` of pictures, or ``.mp4``.

        The file appears only when it is complete.
        """
        call = calls.batch(
            avatar_id, frames, fps, output or Output(), picture_format, archive_type(path)
        )
        with self._streamed(call) as response, complete_file(path) as write:
            for data in response.iter_bytes():
                write(data)

    def stream(self, avatar_id: str, hello: Hello | None = None) -> AbstractContextManager[Stream]:
        """Open a stream for a ``with`` block."""
        return open_stream(
            self.server, avatar_id, hello or Hello(), self._headers, timeout=self.timeout
        )

    def _send(self, call: Call) -> httpx.Response:
        with self._streamed(call) as response:
            response.read()
            return response

    @contextmanager
    def _streamed(self, call: Call) -> Iterator[httpx.Response]:
        """A response of success whose body has not been read; errors of httpx are translated."""
        response = self._opened(call)
        try:
            yield response
        except httpx.HTTPError as error:
            raise replies.transport_error(error, self.server) from error
        finally:
            response.close()

    def _opened(self, call: Call) -> httpx.Response:
        attempt = 0
        while True:
            failure: CVTHeadClientError
            try:
                response = self._http.send(call.request(self._http), stream=True)
                if response.is_success:
                    return response
                try:
                    response.read()
                finally:
                    response.close()
                failure = replies.failure(response)
            except httpx.HTTPError as error:
                failure = replies.transport_error(error, self.server)
                failure.__cause__ = error
            wait = replies.wait_before_retry(self.retry, call, failure, attempt)
            if wait is None:
                raise failure
            time.sleep(wait)
            attempt += 1
