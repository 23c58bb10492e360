"""Retries that create nothing twice (draft-ietf-httpapi-idempotency-key-header-07)."""

from __future__ import annotations

import asyncio
import hashlib
import json
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from starlette.requests import Request

from cvthead.errors import InputError
from cvthead.files import write_file
from service.problems import Problem, retry_after
from service.state import get_service

KEPT_SECONDS = 24 * 3600.0
PURGE_SECONDS = 3600.0


@dataclass
class Claim:
    """One use of a key. ``result``: the avatar's id, None until there is one."""

    result: str | None


class Idempotency:
    """Remembers for a day which avatar a key made, also over a restart.

    Args:
        folder: one small file per key; created when first written.
        clock: seconds since the epoch.
    """

    def __init__(self, folder: Path, clock: Callable[[], float] = time.time) -> None:
        self.folder = folder
        self._clock = clock
        self._running: dict[str, str] = {}
        self._purged = 0.0

    @asynccontextmanager
    async def once(self, owner: str, key: str, fingerprint: str) -> AsyncIterator[Claim]:
        """Claim a key. Its ``result`` is an earlier request's, or set by the block.

        Nothing is remembered of a block that fails, so that it can be tried again.

        Args:
            owner: keys of different owners have nothing to do with each other.
            fingerprint: hash of the body and the options.

        Raises:
            Problem: ``idempotency_mismatch`` (another fingerprint), ``idempotency_conflict``
                (a request with this key has not ended).
        """
        name = hashlib.sha256(f"{owner}\0{key}".encode()).hexdigest()
        if name in self._running:
            if self._running[name] != fingerprint:
                raise Problem("idempotency_mismatch")
            raise Problem("idempotency_conflict", headers=retry_after(1))
        self._running[name] = fingerprint
        try:
            earlier = await asyncio.to_thread(self._read, name)
            if earlier is not None and earlier[0] != fingerprint:
                raise Problem("idempotency_mismatch")
            claim = Claim(earlier and earlier[1])
            yield claim
            if claim.result is not None and earlier != (fingerprint, claim.result):
                await asyncio.to_thread(self._write, name, fingerprint, claim.result)
        finally:
            del self._running[name]

    def _read(self, name: str) -> tuple[str, str] | None:
        """Fingerprint and result; None if unknown, too old or damaged."""
        try:
            data = json.loads((self.folder / f"{name}.json").read_bytes())
            if data["created"] + KEPT_SECONDS > self._clock():
                return str(data["fingerprint"]), str(data["result"])
        except (OSError, ValueError, TypeError, KeyError):
            pass
        return None

    def _write(self, name: str, fingerprint: str, result: str) -> None:
        now = self._clock()
        data = {"fingerprint": fingerprint, "result": result, "created": now}
        # The avatar is stored and can be used; a retry's safety is not worth losing it.
        with suppress(InputError, OSError):
            self.folder.mkdir(mode=0o700, exist_ok=True)
            write_file(self.folder / f"{name}.json", json.dumps(data).encode(), mode=0o600)
            if self._purged + PURGE_SECONDS <= now:
                self._purged = now
                self._purge(now)

    def _purge(self, now: float) -> None:
        for path in self.folder.iterdir():
            with suppress(FileNotFoundError):
                if path.stat().st_mtime + KEPT_SECONDS <= now:
                    path.unlink()


async def idempotency(request: Request) -> Idempotency:
    """The application's; a FastAPI dependency. A coroutine, so that two requests make no two."""
    state = request.app.state
    if not hasattr(state, "idempotency"):
        state.idempotency = Idempotency(get_service(request).cache.folder / "idempotency")
    found: Idempotency = state.idempotency
    return found
