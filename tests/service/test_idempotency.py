from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from pathlib import Path

import pytest

from service.idempotency import KEPT_SECONDS, PURGE_SECONDS, Idempotency
from service.problems import Problem


class Clock:
    def __init__(self) -> None:
        self.now = 1e9

    def __call__(self) -> float:
        return self.now


async def made(once: Idempotency, result: str, key: str = "k", body: str = "b") -> str | None:
    """What is remembered after a request that would make ``result``."""
    async with once.once("ann", key, body) as claim:
        claim.result = claim.result or result
        return claim.result


def run(work: Coroutine[None, None, None]) -> None:
    asyncio.run(work)


def test_the_same_key_and_body_give_the_first_result_also_after_a_restart(tmp_path: Path) -> None:
    async def work() -> None:
        once = Idempotency(tmp_path / "keys")
        assert await made(once, "first") == "first"
        assert await made(once, "second") == "first"
        again = Idempotency(tmp_path / "keys")
        assert await made(again, "third") == "first"
        assert await made(again, "other", key="k2") == "other"
        async with again.once("bob", "k", "another body") as claim:  # another owner's key
            assert claim.result is None

    run(work())


def test_another_body_is_refused(tmp_path: Path) -> None:
    async def work() -> None:
        once = Idempotency(tmp_path / "keys")
        await made(once, "first")
        with pytest.raises(Problem) as caught:
            await made(once, "second", body="b2")
        assert caught.value.code == "idempotency_mismatch"

    run(work())


def test_a_running_request_is_not_repeated(tmp_path: Path) -> None:
    async def work() -> None:
        once = Idempotency(tmp_path / "keys")
        async with once.once("ann", "k", "b") as claim:
            for body, code in (("b", "idempotency_conflict"), ("b2", "idempotency_mismatch")):
                with pytest.raises(Problem) as caught:
                    await made(once, "second", body=body)
                assert caught.value.code == code
            claim.result = "first"
        assert await made(once, "second") == "first"

    run(work())


def test_a_failure_can_be_tried_again(tmp_path: Path) -> None:
    async def work() -> None:
        once = Idempotency(tmp_path / "keys")
        with pytest.raises(ZeroDivisionError):
            async with once.once("ann", "k", "b"):
                raise ZeroDivisionError
        assert await made(once, "second", body="b2") == "second"

    run(work())


def test_keys_are_forgotten_after_a_day(tmp_path: Path) -> None:
    async def work() -> None:
        clock = Clock()
        once = Idempotency(tmp_path / "keys", clock)
        await made(once, "first")
        clock.now += KEPT_SECONDS
        assert await made(once, "second") == "second"

    run(work())


def test_old_files_are_removed(tmp_path: Path) -> None:
    async def work() -> None:
        clock = Clock()
        once = Idempotency(tmp_path, clock)
        await made(once, "first")
        (file,) = tmp_path.iterdir()
        clock.now = file.stat().st_mtime + KEPT_SECONDS + PURGE_SECONDS
        await made(once, "second", key="k2")
        assert file not in tmp_path.iterdir()

    run(work())


def test_a_damaged_file_counts_as_none(tmp_path: Path) -> None:
    async def work() -> None:
        once = Idempotency(tmp_path)
        await made(once, "first")
        (file,) = tmp_path.iterdir()
        for text in ("", "[]", "{}", '{"created": "x"}'):
            file.write_text(text)
            assert await made(once, "again") == "again"

    run(work())
