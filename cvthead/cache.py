"""Avatars by upload id: least recently used in memory over a directory that survives restarts.

The directory holds two files per avatar: ``<id>.avatar`` and, written after it, ``<id>.json`` with
the record. An avatar exists while its record does; an expired one leaves the record behind, so
that it can be told from an id that never was.
"""

from __future__ import annotations

import re
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from types import EllipsisType

from cvthead.errors import (
    AvatarExpiredError,
    AvatarFileError,
    AvatarNotFoundError,
    InputError,
    StoreError,
)
from cvthead.files import write_file
from cvthead.preset import AnyAvatar, load_avatar
from cvthead.record import AvatarRecord, Box, read_record, write_record

SUFFIX, RECORD = ".avatar", ".json"
ID_PATTERN = re.compile(r"[0-9a-f]{32}")
TOMBSTONE_SECONDS = 30 * 86400.0
# Files of an upload that was interrupted; an ongoing one takes far less.
LEFTOVER_SECONDS = 3600.0


def new_id() -> str:
    """A random, unguessable 128-bit id as 32 hex digits."""
    return secrets.token_hex(16)


class AvatarCache:
    """Keeps avatars by upload id. Safe to share between threads, the folder between processes.

    Args:
        folder: two files per avatar, readable by this user alone; created when missing.
        memory_bytes: budget of the in-memory tier; a single larger avatar is still served.
        lifetime: seconds after :meth:`put` until an avatar expires; None keeps it for ever.
        clock: seconds since the epoch.

    Attributes:
        hits, misses: how often :meth:`get` found an avatar in memory, or read its file.
        evictions: how often an avatar left the memory for another.
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
        self.hits = self.misses = self.evictions = 0
        self._clock = clock
        self._lock = threading.Lock()
        self._memory: OrderedDict[str, tuple[AnyAvatar, int]] = OrderedDict()
        # Records never change, so one that was read need not be read again.
        self._records: dict[str, AvatarRecord] = {}
        self._used = 0
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)

    def put(
        self,
        avatar: AnyAvatar,
        *,
        owner: str = "",
        lifetime: float | EllipsisType | None = ...,
        box: Box | None = None,
    ) -> AvatarRecord:
        """Store an avatar under a new id.

        Args:
            owner: the only one who may use it.
            lifetime: seconds until it expires, None for ever; the cache's when left out.
            box: kept in the record.

        Raises:
            StoreError: the folder cannot be written.
        """
        key, data = new_id(), avatar.to_bytes()
        created = round(self._clock(), 6)
        seconds = self.lifetime if isinstance(lifetime, EllipsisType) else lifetime
        expires = None if seconds is None else created + seconds
        record = AvatarRecord(
            key, owner, created, expires, len(data), avatar.preset, avatar.fingerprint, box
        )
        try:
            write_file(self._path(key), data, mode=0o600)
            write_file(self._record_path(key), write_record(record), mode=0o600)
        except InputError as error:
            self._path(key).unlink(missing_ok=True)
            raise StoreError(
                f"the avatar cannot be stored: {error}", hint="try again later, or elsewhere"
            ) from error
        with self._lock:
            self._records[key] = record
            self._remember(key, avatar, len(data))
        return record

    def record(self, key: str, *, owner: str = "") -> AvatarRecord:
        """The record of an id.

        Raises:
            AvatarNotFoundError: never stored here, deleted, or another owner's.
            AvatarExpiredError: its lifetime is over.
            AvatarFileError: its record is damaged.
        """
        record = self._known(key)
        if record is None or record.owner != owner:
            raise AvatarNotFoundError("no such avatar", hint="upload the portrait first")
        if self._expired(record):
            self._path(key).unlink(missing_ok=True)
            self._forget(key)
            raise AvatarExpiredError("the avatar has expired", hint="upload the portrait again")
        return record

    def in_memory(self, key: str) -> bool:
        """Whether :meth:`get` needs no reading from disk; it may still be another owner's."""
        return key in self._memory

    def get(self, key: str, *, owner: str = "") -> AnyAvatar:
        """The avatar of an id.

        Raises:
            AvatarNotFoundError, AvatarExpiredError: see :meth:`record`.
            AvatarFileError: its file is damaged or missing.
        """
        size = self.record(key, owner=owner).bytes
        with self._lock:
            if key in self._memory:
                self.hits += 1
                self._memory.move_to_end(key)
                return self._memory[key][0]
            self.misses += 1
        try:
            avatar: AnyAvatar = load_avatar(self._path(key))
        except AvatarFileError:
            self.record(key, owner=owner)  # another thread may have deleted it meanwhile
            raise
        with self._lock:
            self._remember(key, avatar, size)
        self.record(key, owner=owner)  # the same: it must not stay in memory then
        return avatar

    def delete(self, key: str, *, owner: str = "") -> None:
        """Remove an avatar from memory and folder.

        Raises:
            AvatarNotFoundError, AvatarExpiredError: see :meth:`record`.
        """
        self.record(key, owner=owner)
        self._remove(key)

    def records(
        self, owner: str = "", *, before: tuple[float, str] | None = None, limit: int | None = None
    ) -> list[AvatarRecord]:
        """Records of an owner's avatars that have not expired, newest first.

        Args:
            before: ``place`` of the record after which to continue.
            limit: at most so many.
        """
        own = [r for r in self._all() if r.owner == owner and not self._expired(r)]
        if before is not None:
            own = [record for record in own if record.place < before]
        return sorted(own, key=lambda record: record.place, reverse=True)[:limit]

    def count(self) -> int:
        """Stored avatars of all owners that have not expired."""
        return sum(not self._expired(record) for record in self._all())

    def purge(self) -> int:
        """Remove what has expired, records that expired long ago, and interrupted uploads.

        Returns:
            The number of files removed.
        """
        before = set(self.folder.iterdir())
        now = self._clock()
        for record in self._all():
            if record.expires is not None and record.expires + TOMBSTONE_SECONDS <= now:
                self._remove(record.id)
            elif self._expired(record):
                self._path(record.id).unlink(missing_ok=True)
                self._forget(record.id)
        orphans = [p for p in self.folder.glob(f"*{SUFFIX}") if not p.with_suffix(RECORD).exists()]
        for path in (*orphans, *self.folder.glob(".*.part")):
            modified = _modified(path)
            if modified is not None and modified + LEFTOVER_SECONDS <= now:
                path.unlink(missing_ok=True)
        return len(before - set(self.folder.iterdir()))

    @property
    def used_bytes(self) -> int:
        """File sizes of the avatars held in memory."""
        return self._used

    def _path(self, key: str) -> Path:
        # The pattern also keeps a hostile id from leaving the folder.
        if not ID_PATTERN.fullmatch(key):
            raise AvatarNotFoundError("no such avatar", hint="ids are 32 hexadecimal digits")
        return self.folder / f"{key}{SUFFIX}"

    def _record_path(self, key: str) -> Path:
        return self._path(key).with_suffix(RECORD)

    def _expired(self, record: AvatarRecord) -> bool:
        return record.expires is not None and record.expires <= self._clock()

    def _known(self, key: str) -> AvatarRecord | None:
        """The record of an id, expired or not; None if there is no such avatar (any more)."""
        path = self._record_path(key)
        if path.exists() and key in self._records:
            return self._records[key]
        try:
            record = read_record(path.read_bytes(), key)
        except FileNotFoundError:
            self._forget(key, record=True)  # perhaps another process deleted it
            return None
        except (OSError, ValueError) as error:
            raise AvatarFileError(
                f"{path} is damaged: {error}", hint="delete the file and upload the portrait again"
            ) from error
        with self._lock:
            return self._records.setdefault(key, record)

    def _all(self) -> list[AvatarRecord]:
        found: list[AvatarRecord] = []
        for path in self.folder.glob(f"*{RECORD}"):
            try:
                record = self._known(path.stem)
            except (AvatarFileError, AvatarNotFoundError):
                continue  # a damaged or foreign file must not hide the others
            if record is not None:
                found.append(record)
        return found

    def _remove(self, key: str) -> None:
        # The record first: without it the avatar is gone, whatever happens next.
        self._record_path(key).unlink(missing_ok=True)
        self._path(key).unlink(missing_ok=True)
        self._forget(key, record=True)

    def _remember(self, key: str, avatar: AnyAvatar, size: int) -> None:
        if key in self._memory:
            self._used -= self._memory.pop(key)[1]
        self._memory[key] = (avatar, size)
        self._used += size
        while self._used > self.memory_bytes and len(self._memory) > 1:
            self._used -= self._memory.popitem(last=False)[1][1]
            self.evictions += 1

    def _forget(self, key: str, *, record: bool = False) -> None:
        with self._lock:
            if record:
                self._records.pop(key, None)
            if key in self._memory:
                self._used -= self._memory.pop(key)[1]


def _modified(path: Path) -> float | None:
    """Seconds since the epoch; None if there is no such file (any more)."""
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return None
