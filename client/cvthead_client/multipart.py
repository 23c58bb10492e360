"""Reading a multipart/mixed reply part by part while it arrives (RFC 2046 section 5.1)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from email.message import Message as Header
from email.parser import HeaderParser

from cvthead_client.errors import UnexpectedReplyError, service_error
from cvthead_client.replies import PROBLEM, timings
from cvthead_client.types import Picture

MAX_PART = 32 * 2**20


class PartReader:
    """Feed it the bytes of the reply, take the parts that are complete.

    Args:
        content_type: of the reply; names the boundary.

    Raises:
        UnexpectedReplyError: the type is not multipart/mixed.
    """

    def __init__(self, content_type: str) -> None:
        header = Header()
        header["Content-Type"] = content_type
        boundary = header.get_boundary()
        if header.get_content_type() != "multipart/mixed" or not boundary:
            raise _broken(f"the reply has type {content_type or 'none'}")
        self._delimiter = b"\r\n--" + boundary.encode()
        # The first delimiter needs no line end before it, so pretend one.
        self._buffer = bytearray(b"\r\n")
        self._searched = 0
        self._begun = False
        self._ended = False

    def feed(self, data: bytes) -> Iterator[Picture]:
        """The parts that ``data`` completes.

        Raises:
            ServiceError: a part says that the service could not go on.
            UnexpectedReplyError: a part that is no picture, or larger than MAX_PART.
        """
        self._buffer += data
        while not self._ended:
            at = self._buffer.find(self._delimiter, self._searched)
            after = at + len(self._delimiter)
            # Two more bytes tell whether this delimiter is the last one.
            if at < 0 or len(self._buffer) < after + 2:
                if len(self._buffer) > MAX_PART:
                    raise _broken("a part is too large")
                self._searched = max(0, len(self._buffer) - len(self._delimiter) - 2)
                return
            part = bytes(self._buffer[:at])
            self._ended = self._buffer[after : after + 2] == b"--"
            del self._buffer[:after]
            self._searched = 0
            if self._begun:
                yield _picture(part)
            self._begun = True

    def end(self) -> None:
        """Call this when the reply is over.

        Raises:
            UnexpectedReplyError: it was cut off.
        """
        if not self._ended:
            raise _broken("the reply was cut off")


def _picture(part: bytes) -> Picture:
    head, separator, body = part.partition(b"\r\n\r\n")
    if not separator:
        raise _broken("a part has no end of its header")
    header = HeaderParser().parsestr(head.decode("latin-1").lstrip())
    media_type = header.get_content_type()
    if media_type == PROBLEM:
        try:
            problem = json.loads(body)
        except (ValueError, RecursionError) as error:
            raise _broken("a problem is not JSON") from error
        raise service_error(problem if isinstance(problem, dict) else {})
    if not media_type.startswith("image/"):
        raise _broken(f"a part has type {media_type}")
    return Picture(
        body,
        media_type,
        header.get("X-Digital-Source-Type", ""),
        timings(header.get("Server-Timing", "")),
    )


def _broken(reason: str) -> UnexpectedReplyError:
    return UnexpectedReplyError(
        f"the batch's reply is broken: {reason}", hint="try again; the service may have stopped"
    )
