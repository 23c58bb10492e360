from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from made_avatars import made_avatar, same

from cvthead.cache import AvatarCache
from cvthead.errors import AvatarExpiredError, AvatarFileError, AvatarNotFoundError


class Clock:
    def __init__(self, start: float) -> None:
        self.now = start

    def __call__(self) -> float:
        return self.now


def test_get_returns_what_was_put(tmp_path: Path) -> None:
    cache = AvatarCache(tmp_path)
    keys = [cache.put(made_avatar(i)) for i in range(3)]
    assert len(set(keys)) == 3
    for i, key in enumerate(keys):
        assert same(cache.get(key), made_avatar(i))
    assert list(cache.ids()) == sorted(
        keys, key=lambda k: (tmp_path / f"{k}.avatar").stat().st_mtime
    )


def test_survives_restart(tmp_path: Path) -> None:
    key = AvatarCache(tmp_path).put(made_avatar(5))
    assert same(AvatarCache(tmp_path).get(key), made_avatar(5))


def test_memory_stays_within_budget_and_keeps_recent(tmp_path: Path) -> None:
    size = len(made_avatar().to_bytes())
    cache = AvatarCache(tmp_path, memory_bytes=2 * size + size // 2)
    first, second = cache.put(made_avatar(1)), cache.put(made_avatar(2))
    kept = cache.get(first)  # now the most recent
    cache.put(made_avatar(3))  # drops the second
    assert cache.used_bytes <= 2 * size + size // 2
    assert cache.get(first) is kept
    assert same(cache.get(second), made_avatar(2))  # from the folder


def test_expiry_is_told_from_unknown(tmp_path: Path) -> None:
    path = tmp_path / "store"
    cache = AvatarCache(path, lifetime=60)
    key = cache.put(made_avatar())
    expires = cache.expires(key)
    assert expires is not None
    clock = Clock(expires - 1)
    cache = AvatarCache(path, lifetime=60, clock=clock)
    cache.get(key)
    clock.now = expires
    assert list(cache.ids()) == []
    for _ in range(2):
        with pytest.raises(AvatarExpiredError):
            cache.get(key)
    with pytest.raises(AvatarNotFoundError):
        cache.get("0" * 32)


@pytest.mark.parametrize("key", ["", "../../etc/passwd", "A" * 32, "0" * 31, "0" * 33, "é" * 32])
def test_hostile_ids_are_unknown(tmp_path: Path, key: str) -> None:
    with pytest.raises(AvatarNotFoundError):
        AvatarCache(tmp_path).get(key)


def test_delete_removes_every_tier(tmp_path: Path) -> None:
    cache = AvatarCache(tmp_path)
    key = cache.put(made_avatar())
    cache.delete(key)
    with pytest.raises(AvatarNotFoundError):
        cache.get(key)
    with pytest.raises(AvatarNotFoundError):
        cache.delete(key)
    assert cache.used_bytes == 0
    assert not list(tmp_path.glob("*.avatar"))


@pytest.mark.parametrize("keep", [0, 7, 100, -1])
def test_damaged_file_is_named(tmp_path: Path, keep: int) -> None:
    key = AvatarCache(tmp_path).put(made_avatar())
    file = tmp_path / f"{key}.avatar"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(AvatarFileError, match=key):
        AvatarCache(tmp_path).get(key)


def test_threads_share_one_cache(tmp_path: Path) -> None:
    """Readers and deleters at once see an avatar or "not found", never another error."""
    size = len(made_avatar().to_bytes())
    cache = AvatarCache(tmp_path, memory_bytes=2 * size)  # so that most reads go to the folder
    keys = [cache.put(made_avatar(i)) for i in range(12)]

    def read(number: int) -> bool:
        try:
            return same(cache.get(keys[number % len(keys)]), made_avatar(number % len(keys)))
        except AvatarNotFoundError:
            return number % len(keys) >= 6

    def delete(key: str) -> bool:
        cache.delete(key)
        return len(list(cache.ids())) <= len(keys)

    with ThreadPoolExecutor(8) as pool:
        reads = [pool.submit(read, n) for n in range(240)]
        deletions = [pool.submit(delete, key) for key in keys[6:]]
        reads += [pool.submit(read, n) for n in range(240)]
    assert all(task.result() for task in reads + deletions)
    assert sorted(cache.ids()) == sorted(keys[:6])
    assert cache.used_bytes <= 2 * size + 64
