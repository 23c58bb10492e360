"""Avatars by upload id: least recently used in memory over a directory that survives restarts."""

from __future__ import annotations

import re
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path

from cvthead.avatar import Avatar
from cvthead.errors import AvatarExpiredError, AvatarFileError, AvatarNotFoundError

SUFFIX = ".avatar"
# A tombstone lets an expired id be told apart from one that never was.
TOMBSTONE = ".expired"
ID_PATTERN = re.compile(r"[0-9a-f]{32}")


def new_id() -> str:
    """A random, unguessable 128-bit id as 32 hex digits."""
    return secrets.token_hex(16)


class AvatarCache:
    """Keeps avatars by upload id. Safe to share between threads.

    Args:
        folder: one file per avatar; created when missing.
        memory_bytes: budget of the in-memory tier; a single larger avatar is still served.
        lifetime: seconds after :meth:`put` until an avatar expires; None keeps it for ever.
        clock: seconds since the epoch.
    """

    def __init__(
        self,
        folder: Path,
        *,
        memory_bytes: int = 256 * 2**20,
        lifetime: float | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.folder = folder
        self.memory_bytes = memory_bytes
        self.lifetime = lifetime
        self._clock = clock
        self._lock = threading.Lock()
        self._memory: OrderedDict[str, tuple[Avatar, int]] = OrderedDict()
        self._used = 0
        folder.mkdir(parents=True, exist_ok=True)

    def put(self, avatar: Avatar) -> str:
        """Store an avatar under a new id."""
        key = new_id()
        path = self._path(key)
        avatar.save(path)
        with self._lock:
            self._remember(key, avatar, path.stat().st_size)
        return key

    def get(self, key: str) -> Avatar:
        """The avatar of an id.

        Raises:
            AvatarNotFoundError: never stored here, or deleted.
            AvatarExpiredError: its lifetime is over.
            AvatarFileError: its file is damaged.
        """
        path = self._path(key)
        self._check(key, path)
        with self._lock:
            if key in self._memory:
                self._memory.move_to_end(key)
                return self._memory[key][0]
        try:
            avatar, size = Avatar.load(path), path.stat().st_size
        except (AvatarFileError, FileNotFoundError):
            self._check(key, path)  # another thread may have deleted it meanwhile
            raise
        with self._lock:
            self._remember(key, avatar, size)
        self._check(key, path)  # the same: it must not stay in memory then
        return avatar

    def expires(self, key: str) -> float | None:
        """When the avatar expires, in seconds since the epoch."""
        written = self._check(key, self._path(key))
        return None if self.lifetime is None else written + self.lifetime

    def delete(self, key: str) -> None:
        """Remove an avatar from memory and folder.

        Raises:
            AvatarNotFoundError: never stored here, or already deleted.
        """
        path = self._path(key)
        self._check(key, path)
        path.unlink(missing_ok=True)
        self._forget(key)

    def ids(self) -> Iterator[str]:
        """Ids of the stored avatars that have not expired, oldest first."""
        files = [(_written(path), path.stem) for path in self.folder.glob(f"*{SUFFIX}")]
        for written, key in sorted((w, k) for w, k in files if w is not None):
            if ID_PATTERN.fullmatch(key) and not self._expired(written):
                yield key

    @property
    def used_bytes(self) -> int:
        """File sizes of the avatars held in memory."""
        return self._used

    def _path(self, key: str) -> Path:
        # The pattern also keeps a hostile id from leaving the folder.
        if not ID_PATTERN.fullmatch(key):
            raise AvatarNotFoundError("no such avatar", hint="ids are 32 hexadecimal digits")
        return self.folder / f"{key}{SUFFIX}"

    def _expired(self, written: float) -> bool:
        return self.lifetime is not None and written + self.lifetime <= self._clock()

    def _check(self, key: str, path: Path) -> float:
        """When the avatar was stored; an expired one is removed. Errors as :meth:`get`."""
        tombstone = path.with_suffix(TOMBSTONE)
        written = _written(path)
        if written is not None and not self._expired(written):
            return written
        if written is not None:
            tombstone.touch()
            path.unlink(missing_ok=True)
        self._forget(key)
        if tombstone.exists():
            raise AvatarExpiredError("the avatar has expired", hint="upload the portrait again")
        raise AvatarNotFoundError("no such avatar", hint="upload the portrait first")

    def _remember(self, key: str, avatar: Avatar, size: int) -> None:
        if key in self._memory:
            self._used -= self._memory.pop(key)[1]
        self._memory[key] = (avatar, size)
        self._used += size
        while self._used > self.memory_bytes and len(self._memory) > 1:
            self._used -= self._memory.popitem(last=False)[1][1]

    def _forget(self, key: str) -> None:
        with self._lock:
            if key in self._memory:
                self._used -= self._memory.pop(key)[1]


def _written(path: Path) -> float | None:
    """Seconds since the epoch; None if there is no such file (any more)."""
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return None
