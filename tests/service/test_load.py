"""The load command: its table against a real server, and its figures."""

from __future__ import annotations

import re

import httpx
import pytest
from server_process import Server

from service.load import Answer, Row, main, table, verdict


def test_prints_a_row_per_number_of_clients(
    server: Server, client: httpx.Client, capsys: pytest.CaptureFixture[str]
) -> None:
    before = client.get("/v1/avatars", params={"limit": 1}).json()["items"]
    assert main(["--url", server.url, "--clients", "1,3", "--seconds", "1.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [re.findall(r"[\d.]+", line) for line in lines if re.match(r"\| \d", line)]
    assert [row[0] for row in rows] == ["1", "3"]
    for row in rows:
        _, per_second, p50, p95, p99, model, outside, share, refused = map(float, row)
        assert per_second > 0
        assert 0 < p50 <= p95 <= p99
        assert 0 < model < p99
        assert outside > 0
        assert 0 < share < 100
        assert refused == 0
    assert "One client:" in lines[-1]
    # Its own avatar is gone again.
    assert client.get("/v1/avatars", params={"limit": 1}).json()["items"] == before


def test_service_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--url", "http://127.0.0.1:9"]) == 2
    assert "http://127.0.0.1:9" in capsys.readouterr().err


def _row(*milliseconds: float, model: float = 10.0) -> Row:
    answers = tuple(Answer(200, m, {"pose": 1.0, "paint": model - 1.0}) for m in milliseconds)
    return Row(1, 2.0, answers)


def test_percentiles_are_of_the_nearest_rank() -> None:
    row = _row(*map(float, range(100, 0, -1)))
    assert [row.percentile(p) for p in (50, 95, 99, 100)] == [50, 95, 99, 100]
    assert _row(7.0).percentile(99) == 7
    assert row.per_second == 50


@pytest.mark.parametrize(
    ("milliseconds", "model", "word"),
    [(12.9, 10, "within"), (13.1, 10, "over"), (109.9, 100, "within"), (110.1, 100, "over")],
)
def test_verdict_allows_3_ms_or_a_tenth(milliseconds: float, model: float, word: str) -> None:
    assert f", {word} the" in verdict(_row(milliseconds, model=model))


def test_refused_requests_count_beside() -> None:
    answers = (Answer(200, 20.0, {"paint": 15.0}), Answer(503, 1.0, {}))
    row = Row(4, 1.0, answers)
    assert row.per_second == 1
    assert row.outside == 5
    assert row.share == pytest.approx(0.25)
    assert table([row]).splitlines()[2].split("|")[-2].strip() == "1"
