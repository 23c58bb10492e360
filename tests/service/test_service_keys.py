"""Keys, tickets, rate limit: the parts by themselves."""

from __future__ import annotations

import asyncio
import hmac

import pytest
from pydantic import SecretStr

from service.keys import MAX_TICKETS, KeyRing, Tenant, Tickets
from service.limits import RateLimiter
from service.problems import Problem

ALICE, BOB, NEW = "0123456789abcdef", "fedcba9876543210", "0f1e2d3c4b5a6978"


@pytest.fixture
def ring() -> KeyRing:
    pairs = (f"alice:{ALICE}", f"bob:{BOB}", f"alice:{NEW}")
    return KeyRing(SecretStr(pair) for pair in pairs)


def test_each_key_has_its_tenant(ring: KeyRing) -> None:
    assert ring
    assert ring.find(ALICE) == ring.find(NEW) == Tenant("alice")
    assert ring.find(BOB) == Tenant("bob")


@pytest.mark.parametrize("key", ["", "x", ALICE[:-1], ALICE + "0", ALICE.upper(), "ü", "\ud800"])
def test_other_keys_have_none(key: str, ring: KeyRing) -> None:
    assert ring.find(key) is None


def test_every_key_is_compared_in_constant_time(
    ring: KeyRing, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared: list[tuple[bytes, bytes]] = []
    original = hmac.compare_digest

    def counting(a: bytes, b: bytes) -> bool:
        compared.append((a, b))
        return original(a, b)

    monkeypatch.setattr(hmac, "compare_digest", counting)
    for key in (ALICE, BOB, "x"):  # the first match must not end the search
        compared.clear()
        ring.find(key)
        assert len(compared) == 3
        assert {len(value) for pair in compared for value in pair} == {32}


def test_no_keys_is_false() -> None:
    assert not KeyRing(())


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_ticket_is_valid_once_and_not_for_long() -> None:
    clock = Clock()
    tickets = Tickets(30, clock)
    first, second = tickets.issue(Tenant("alice")), tickets.issue(Tenant("bob"))
    assert first != second
    assert tickets.redeem(first) == Tenant("alice")
    assert tickets.redeem(first) is None
    clock.now = 29.9
    third = tickets.issue(Tenant("alice"))
    clock.now = 30
    assert tickets.redeem(second) is None
    assert tickets.redeem(third) == Tenant("alice")
    assert tickets.redeem("unknown") is None


def test_unused_tickets_are_bounded_and_forgotten() -> None:
    clock = Clock()
    tickets = Tickets(30, clock)
    tickets._issued = {str(i): (Tenant(""), 30.0) for i in range(MAX_TICKETS)}
    with pytest.raises(Problem, match="tickets"):
        tickets.issue(Tenant(""))
    clock.now = 30
    assert tickets.redeem(tickets.issue(Tenant(""))) == Tenant("")
    assert not tickets._issued


def test_each_client_has_its_own_rate() -> None:
    asyncio.run(_three_are_allowed())


async def _three_are_allowed() -> None:
    limiter = RateLimiter(3)
    for _ in range(3):
        await limiter.check("key alice")
    with pytest.raises(Problem) as caught:
        await limiter.check("key alice")
    assert caught.value.status_code == 429
    assert caught.value.headers is not None
    assert 1 <= int(caught.value.headers["Retry-After"]) <= 61
    await limiter.check("key bob")


def test_zero_is_no_limit() -> None:
    async def thousand() -> None:
        limiter = RateLimiter(0)
        for _ in range(1000):
            await limiter.check("key alice")

    asyncio.run(thousand())
