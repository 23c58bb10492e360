from __future__ import annotations

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from made_avatars import made_avatar, same

from cvthead.cache import LEFTOVER_SECONDS, TOMBSTONE_SECONDS, AvatarCache
from cvthead.errors import (
    AvatarExpiredError,
    AvatarFileError,
    AvatarNotFoundError,
    StoreError,
)


class Clock:
    def __init__(self, start: float) -> None:
        self.now = start

    def __call__(self) -> float:
        return self.now


def ids(cache: AvatarCache, owner: str = "") -> list[str]:
    return [record.id for record in cache.records(owner)]


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_get_returns_what_was_put(tmp_path: Path) -> None:
    cache = AvatarCache(tmp_path)
    keys = [cache.put(made_avatar(i)).id for i in range(3)]
    assert len(set(keys)) == 3
    for i, key in enumerate(keys):
        assert same(cache.get(key), made_avatar(i))
    assert sorted(ids(cache)) == sorted(keys)


def test_survives_restart(tmp_path: Path) -> None:
    record = AvatarCache(tmp_path).put(
        made_avatar(5), owner="ann", lifetime=60, box=(1.5, 2.0, 30.0, 40.0)
    )
    again = AvatarCache(tmp_path)
    assert again.record(record.id, owner="ann") == record
    assert same(again.get(record.id, owner="ann"), made_avatar(5))
    assert again.records("ann") == [record]


def test_record_describes_the_avatar(tmp_path: Path) -> None:
    clock = Clock(1000.0)
    record = AvatarCache(tmp_path, lifetime=60, clock=clock).put(made_avatar(3))
    assert (record.created, record.expires) == (1000.0, 1060.0)
    assert (record.preset, record.fingerprint) == ("open", f"{3:016x}")
    assert record.bytes == (tmp_path / f"{record.id}.avatar").stat().st_size
    assert AvatarCache(tmp_path, lifetime=60).put(made_avatar(), lifetime=None).expires is None


def test_only_the_user_may_read_the_files(tmp_path: Path) -> None:
    AvatarCache(tmp_path / "new").put(made_avatar())
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "new").iterdir()} == {0o600}
    assert (tmp_path / "new").stat().st_mode & 0o077 == 0


def test_an_owners_avatars_do_not_exist_for_others(tmp_path: Path) -> None:
    clock = Clock(1000.0)
    cache = AvatarCache(tmp_path, clock=clock)
    key = cache.put(made_avatar(), owner="ann", lifetime=60).id
    cache.get(key, owner="ann")
    for now in (1000.0, 2000.0):  # not even as an expired one
        clock.now = now
        for owner in ("", "bob"):
            for use in (cache.get, cache.record, cache.delete):
                with pytest.raises(AvatarNotFoundError):
                    use(key, owner=owner)
            assert cache.records(owner) == []
    with pytest.raises(AvatarExpiredError):
        cache.get(key, owner="ann")


def test_memory_stays_within_budget_and_keeps_recent(tmp_path: Path) -> None:
    size = len(made_avatar().to_bytes())
    cache = AvatarCache(tmp_path, memory_bytes=2 * size + size // 2)
    first, second = cache.put(made_avatar(1)).id, cache.put(made_avatar(2)).id
    kept = cache.get(first)  # now the most recent
    cache.put(made_avatar(3))  # drops the second
    assert cache.used_bytes <= 2 * size + size // 2
    assert cache.get(first) is kept
    assert same(cache.get(second), made_avatar(2))  # from the folder
    assert (cache.hits, cache.misses, cache.evictions) == (2, 1, 2)


def test_expiry_is_told_from_unknown(tmp_path: Path) -> None:
    clock = Clock(1000.0)
    cache = AvatarCache(tmp_path, lifetime=60, clock=clock)
    key = cache.put(made_avatar()).id
    clock.now = 1059.0
    cache.get(key)
    clock.now = 1060.0
    assert ids(cache) == []
    for _ in range(2):
        with pytest.raises(AvatarExpiredError):
            cache.get(key)
    with pytest.raises(AvatarExpiredError):
        AvatarCache(tmp_path, clock=clock).get(key)  # whatever the lifetime is now
    assert not list(tmp_path.glob("*.avatar"))
    assert cache.used_bytes == 0
    with pytest.raises(AvatarNotFoundError):
        cache.get("0" * 32)


@pytest.mark.parametrize("key", ["", "../../etc/passwd", "A" * 32, "0" * 31, "0" * 33, "é" * 32])
def test_hostile_ids_are_unknown(tmp_path: Path, key: str) -> None:
    with pytest.raises(AvatarNotFoundError):
        AvatarCache(tmp_path).get(key)


def test_delete_removes_every_tier(tmp_path: Path) -> None:
    cache = AvatarCache(tmp_path)
    key = cache.put(made_avatar()).id
    cache.delete(key)
    with pytest.raises(AvatarNotFoundError):
        cache.get(key)
    with pytest.raises(AvatarNotFoundError):
        cache.delete(key)
    assert cache.used_bytes == 0
    assert names(tmp_path) == set()


def test_another_process_deletes(tmp_path: Path) -> None:
    cache = AvatarCache(tmp_path)
    key = cache.put(made_avatar()).id
    AvatarCache(tmp_path).delete(key)
    assert ids(cache) == []
    with pytest.raises(AvatarNotFoundError):
        cache.get(key)
    assert cache.used_bytes == 0


def test_pages_are_newest_first_and_complete_under_deletion(tmp_path: Path) -> None:
    clock = Clock(1000.0)
    cache = AvatarCache(tmp_path, clock=clock)
    keys = []
    for i in range(5):
        clock.now += i % 2  # two at the same time
        keys.append(cache.put(made_avatar(i)).id)
    first = cache.records(limit=2)
    cache.delete(first[-1].id)  # the place after which the next page starts
    rest = cache.records(before=first[-1].place)
    assert {r.id for r in first + rest} == set(keys)
    places = [r.place for r in first + rest]
    assert places == sorted(places, reverse=True)


def test_purge_removes_expired_old_records_and_leftovers(tmp_path: Path) -> None:
    clock = Clock(time.time())
    cache = AvatarCache(tmp_path, clock=clock)
    kept = cache.put(made_avatar(1)).id
    short = cache.put(made_avatar(2), lifetime=60).id
    for name in ("0" * 32 + ".avatar", ".x.avatar.12345678.part"):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (clock.now, clock.now))
    everything = names(tmp_path)
    assert cache.purge() == 0  # the leftovers may belong to an upload that goes on
    assert names(tmp_path) == everything
    clock.now += LEFTOVER_SECONDS
    assert cache.purge() == 3
    assert names(tmp_path) == {f"{kept}.avatar", f"{kept}.json", f"{short}.json"}
    with pytest.raises(AvatarExpiredError):
        cache.get(short)
    clock.now += TOMBSTONE_SECONDS
    assert cache.purge() == 1
    with pytest.raises(AvatarNotFoundError):
        cache.get(short)
    cache.get(kept)


@pytest.mark.parametrize("keep", [0, 7, 100, -1])
def test_damaged_file_is_named(tmp_path: Path, keep: int) -> None:
    key = AvatarCache(tmp_path).put(made_avatar()).id
    file = tmp_path / f"{key}.avatar"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(AvatarFileError, match=key):
        AvatarCache(tmp_path).get(key)


@pytest.mark.parametrize("text", ["", "[]", '{"id": 1}', '{"box": [1, "x"]}', "\x00"])
def test_damaged_record_hides_no_other(tmp_path: Path, text: str) -> None:
    cache = AvatarCache(tmp_path)
    broken, good = cache.put(made_avatar()).id, cache.put(made_avatar(1)).id
    (tmp_path / f"{broken}.json").write_text(text)
    (tmp_path / "notes.json").write_text("mine")
    cache = AvatarCache(tmp_path)
    assert ids(cache) == [good]
    with pytest.raises(AvatarFileError, match=broken):
        cache.get(broken)


def test_record_cannot_name_another_id(tmp_path: Path) -> None:
    key = AvatarCache(tmp_path).put(made_avatar()).id
    file = tmp_path / f"{key}.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"id": "../../etc/passwd"}))
    assert ids(AvatarCache(tmp_path)) == [key]


def test_store_that_cannot_be_written(tmp_path: Path) -> None:
    cache = AvatarCache(tmp_path / "store")
    (tmp_path / "store").rmdir()
    with pytest.raises(StoreError):
        cache.put(made_avatar())
    assert cache.used_bytes == 0


def test_threads_share_one_cache(tmp_path: Path) -> None:
    """Readers and deleters at once see an avatar or "not found", never another error."""
    size = len(made_avatar().to_bytes())
    cache = AvatarCache(tmp_path, memory_bytes=2 * size)  # so that most reads go to the folder
    keys = [cache.put(made_avatar(i)).id for i in range(12)]

    def read(number: int) -> bool:
        try:
            return same(cache.get(keys[number % len(keys)]), made_avatar(number % len(keys)))
        except AvatarNotFoundError:
            return number % len(keys) >= 6

    def delete(key: str) -> bool:
        cache.delete(key)
        return len(cache.records()) <= len(keys)

    with ThreadPoolExecutor(8) as pool:
        reads = [pool.submit(read, n) for n in range(240)]
        deletions = [pool.submit(delete, key) for key in keys[6:]]
        reads += [pool.submit(read, n) for n in range(240)]
    assert all(task.result() for task in reads + deletions)
    assert sorted(ids(cache)) == sorted(keys[:6])
    assert cache.used_bytes <= 2 * size + 64
