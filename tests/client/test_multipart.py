"""multipart/mixed in pieces of any size."""

from __future__ import annotations

import pytest
from cvthead_client.errors import NoFaceError, UnexpectedReplyError
from cvthead_client.multipart import MAX_PART, PartReader
from cvthead_client.types import Picture

TYPE = 'multipart/mixed; boundary="b-1"'
# The second body holds what looks like line ends and the beginning of a delimiter.
BODIES = [b"first", b"\r\n--b-\r\n\r\n--b", b"", bytes(range(256))]
HEAD = b"--b-1\r\nContent-Type: image/png\r\nServer-Timing: paint;dur=2\r\n\r\n"
WHOLE = b"".join(HEAD + body + b"\r\n" for body in BODIES) + b"--b-1--\r\n"


@pytest.mark.parametrize("size", [1, 2, 3, 7, 50, 10_000])
def test_parts_come_out_whole(size: int) -> None:
    reader = PartReader(TYPE)
    pictures: list[Picture] = []
    for start in range(0, len(WHOLE), size):
        pictures += reader.feed(WHOLE[start : start + size])
    reader.end()
    assert [picture.data for picture in pictures] == BODIES
    assert {picture.media_type for picture in pictures} == {"image/png"}
    assert pictures[0].timings == {"paint": 2.0}


def test_a_part_comes_as_soon_as_it_is_complete() -> None:
    reader = PartReader(TYPE)
    assert list(reader.feed(HEAD + b"first")) == []
    assert [p.data for p in reader.feed(b"\r\n--b-1\r\n")] == [b"first"]


def test_reply_that_is_cut_off() -> None:
    reader = PartReader(TYPE)
    assert len(list(reader.feed(WHOLE[:-10]))) == len(BODIES) - 1
    with pytest.raises(UnexpectedReplyError, match="cut off"):
        reader.end()


def test_problem_in_the_middle_is_raised() -> None:
    part = b'--b-1\r\nContent-Type: application/problem+json\r\n\r\n{"code": "no_face"}\r\n--b-1--'
    with pytest.raises(NoFaceError):
        list(PartReader(TYPE).feed(part))


@pytest.mark.parametrize("content_type", ["", "image/png", "multipart/mixed"])
def test_other_types(content_type: str) -> None:
    with pytest.raises(UnexpectedReplyError):
        PartReader(content_type)


@pytest.mark.parametrize(
    "part",
    [
        b"--b-1\r\nContent-Type: text/html\r\n\r\n<html>\r\n--b-1--",
        b"--b-1\r\nno end of the header\r\n--b-1--",
        b"--b-1\r\nContent-Type: application/problem+json\r\n\r\nnot JSON\r\n--b-1--",
    ],
)
def test_parts_that_are_no_pictures(part: bytes) -> None:
    with pytest.raises(UnexpectedReplyError):
        list(PartReader(TYPE).feed(part))


def test_endless_part() -> None:
    reader = PartReader(TYPE)
    list(reader.feed(bytes(MAX_PART - 10)))
    with pytest.raises(UnexpectedReplyError, match="too large"):
        list(reader.feed(bytes(20)))
