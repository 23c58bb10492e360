from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cvthead.avatar import Avatar
from cvthead.cache import AvatarCache
from cvthead.camera import Camera, Crop
from cvthead.coefficients import Coefficients
from cvthead.deformation import Deformation
from cvthead.errors import AvatarExpiredError, AvatarFileError, AvatarNotFoundError


def made_avatar(seed: int = 0, points: int = 50) -> Avatar:
    rng = np.random.default_rng(seed)
    return Avatar(
        rng.normal(size=(points, 24)).astype(np.float16),
        Deformation(
            rng.normal(size=(30, 3)).astype(np.float16).astype(np.float32),
            rng.integers(0, 30, 7).astype(np.int32),
            rng.normal(size=(7, 3)).astype(np.float16).astype(np.float32),
        ),
        Coefficients.zeros(),
        Camera(5.5, 0.01, -0.02),
        Crop(3.0, 4.0, 200.0),
        b"jpeg bytes",
        "open",
        f"{seed:016x}",
    )


def same(a: Avatar, b: Avatar) -> bool:
    # Not the bytes of the files: safetensors orders its metadata at random.
    return plain(a) == plain(b) and all(map(np.array_equal, arrays(a), arrays(b)))


def plain(a: Avatar) -> tuple[object, ...]:
    return a.camera, a.crop, a.background, a.preset, a.fingerprint


def arrays(a: Avatar) -> tuple[np.ndarray, ...]:
    d, c = a.deformation, a.coefficients
    shell = d.shell_anchor, d.shell_offset
    return a.descriptors, d.offsets, *shell, c.shape, c.expression, c.pose


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
