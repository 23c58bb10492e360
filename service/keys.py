"""Who is calling: API keys, single-use tickets for browsers' WebSockets, origins."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import Depends, Request
from fastapi.security import HTTPBearer
from pydantic import SecretStr
from starlette.requests import HTTPConnection

from service.problems import Problem

MAX_TICKETS = 10_000


@dataclass(frozen=True)
class Tenant:
    """Owner of avatars. The name is empty when no keys are set."""

    name: str


class KeyRing:
    """The API keys. Compared in constant time, so that answers' times tell nothing of them.

    Args:
        entries: ``name:key``.
    """

    def __init__(self, entries: Iterable[SecretStr]) -> None:
        pairs = (entry.get_secret_value().split(":", 1) for entry in entries)
        # Digests have one length; plain keys would show theirs in the time of the comparison.
        self._digests = [(_digest(key), Tenant(name)) for name, key in pairs]

    def __bool__(self) -> bool:
        return bool(self._digests)

    def find(self, key: str) -> Tenant | None:
        """The tenant of a key; every stored key is compared, also after a match."""
        given, found = _digest(key), None
        for digest, tenant in self._digests:
            if hmac.compare_digest(given, digest):
                found = tenant
        return found


class Tickets:
    """Short-lived tickets that open one WebSocket each, because browsers cannot send a key there.

    Args:
        lifetime: seconds.
        clock: seconds, never going back.
    """

    def __init__(self, lifetime: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.lifetime = lifetime
        self._clock = clock
        self._issued: dict[str, tuple[Tenant, float]] = {}

    def issue(self, tenant: Tenant) -> str:
        """A new ticket of 256 random bits.

        Raises:
            Problem: ``overloaded``, when very many wait to be used.
        """
        now = self._clock()
        for ticket in [t for t, (_, expires) in self._issued.items() if expires <= now]:
            del self._issued[ticket]
        if len(self._issued) >= MAX_TICKETS:
            raise Problem("overloaded", "too many unused tickets", headers={"Retry-After": "30"})
        ticket = secrets.token_urlsafe(32)
        self._issued[ticket] = (tenant, now + self.lifetime)
        return ticket

    def redeem(self, ticket: str) -> Tenant | None:
        """Whom the ticket was given to; None if it is unknown, used or too old."""
        tenant, expires = self._issued.pop(ticket, (None, 0.0))
        return tenant if self._clock() < expires else None


async def tenant(
    request: Request, _: Annotated[object, Depends(HTTPBearer(auto_error=False))]
) -> Tenant:
    """Authenticate an HTTP request and count it; a FastAPI dependency.

    Raises:
        Problem: ``unauthorized``, ``rate_limited``.
    """
    return await authenticated(request)


TenantDep = Annotated[Tenant, Depends(tenant)]


async def authenticated(connection: HTTPConnection, *, ticket: str | None = None) -> Tenant:
    """The tenant of a request, or of a WebSocket handshake, which may bring a ticket instead.

    Raises:
        Problem: ``unauthorized``, ``rate_limited``.
    """
    service = connection.app.state.service
    address = f"address {connection.client.host}" if connection.client else "address"
    if not service.keys:
        await service.limiter.check(address)
        return Tenant("")
    scheme, _, key = connection.headers.get("authorization", "").partition(" ")
    found: Tenant | None = None
    if scheme.lower() == "bearer":
        found = service.keys.find(key.strip())
    elif ticket:
        found = service.tickets.redeem(ticket)
    if found is None:
        await service.limiter.check(address)  # guessing is slowed down too
        raise Problem("unauthorized", headers={"WWW-Authenticate": "Bearer"})
    await service.limiter.check(f"key {found.name}")
    return found


def origin_allowed(connection: HTTPConnection, allowed: Collection[str]) -> bool:
    """Whether a browser's page may call: the service's own page, or one of ``allowed``.

    Programs send no Origin; they are not a way for a foreign page to act for its visitor.
    """
    origin = connection.headers.get("origin")
    if origin is None or "*" in allowed or origin in allowed:
        return True
    return urlsplit(origin).netloc.lower() == connection.headers.get("host", "").lower()


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode("utf-8", "surrogatepass")).digest()
