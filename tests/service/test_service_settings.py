"""Where settings come from, and what is refused."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from pydantic import SecretStr

from cvthead.errors import InputError
from service.settings import FILE_VARIABLE, load_settings

KEYS = "alice:0123456789abcdef,bob:fedcba9876543210"


@pytest.fixture(autouse=True)
def _no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("CVTHEAD_")]:
        monkeypatch.delenv(name)


def test_defaults_are_for_this_machine_alone() -> None:
    settings = load_settings()
    assert settings.on_loopback
    assert settings.hosts == ("localhost", "127.0.0.1", "::1", "127.0.0.1")
    assert not settings.consent


def test_arguments_win_over_environment_over_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "service.toml"
    file.write_text('port = 1\nmax_batch = 2\nencode_queue = 3\nkeys = ["a:0123456789abcdef"]\n')
    monkeypatch.setenv(FILE_VARIABLE, str(file))
    monkeypatch.setenv("CVTHEAD_MAX_BATCH", "20")
    monkeypatch.setenv("CVTHEAD_ENCODE_QUEUE", "30")
    settings = load_settings(encode_queue=300, port=None)
    assert (settings.port, settings.max_batch, settings.encode_queue) == (1, 20, 300)
    assert settings.keys == (SecretStr("a:0123456789abcdef"),)


def test_lists_are_written_with_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CVTHEAD_KEYS", KEYS)
    monkeypatch.setenv("CVTHEAD_CORS_ORIGINS", "https://a.example, https://b.example,")
    monkeypatch.setenv("CVTHEAD_ALLOWED_HOSTS", "*.Example.com")
    settings = load_settings()
    assert [key.get_secret_value() for key in settings.keys] == KEYS.split(",")
    assert settings.cors_origins == ("https://a.example", "https://b.example")
    assert settings.hosts == ("*.example.com",)
    assert settings.consent, "as soon as keys are set"


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "example.com"])
def test_beyond_loopback_only_with_keys(host: str) -> None:
    with pytest.raises(InputError, match="no keys are set"):
        load_settings(host=host)
    assert load_settings(host=host, keys=KEYS).hosts == ("*",)
    assert not load_settings(host=host, open_network=True).on_loopback


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_loopback_needs_no_keys(host: str) -> None:
    assert load_settings(host=host).on_loopback


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("port", "70000"),
        ("max_batch", "0"),
        ("memory_bytes", "-1"),
        ("log_level", "loud"),
        ("lifetime_seconds", "nan"),
        ("drain_seconds", "inf"),
        ("preset", "paper"),
        ("allowed_hosts", "a*.example.com"),
    ],
)
def test_wrong_values_are_named(name: str, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(f"CVTHEAD_{name.upper()}", value)
    with pytest.raises(InputError, match=name):
        load_settings()


def test_lifetime_within_the_longest() -> None:
    with pytest.raises(InputError, match="lifetime_max_seconds"):
        load_settings(lifetime_seconds=100.0, lifetime_max_seconds=10.0)


@pytest.mark.parametrize(
    "keys",
    [
        "hunter2-hunter2-hunter2",
        "alice:hunter2",
        "Alice Smith:hunter2-hunter2-hunter2",
        "alice:hunter2-hunter2-hunter2,bob:hunter2-hunter2-hunter2",
        "alice:hunter2-hunter2-hünter2",
    ],
)
def test_malformed_keys_are_refused_and_never_shown(
    keys: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CVTHEAD_KEYS", keys)
    with pytest.raises(InputError, match="key") as caught:
        load_settings()
    error = caught.value
    assert "hunter2" not in f"{error} {error!r} {error.hint} {error.__context__}"


def test_keys_are_not_in_the_text_of_settings() -> None:
    assert "0123456789abcdef" not in f"{load_settings(keys=KEYS)!r} {load_settings(keys=KEYS)!s}"


@pytest.mark.parametrize(
    "text", ["port = 'x", "nonsense = 1\n", "port = 8001\nkeys = [1]\n", "\xff"]
)
def test_a_wrong_file_is_refused(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "service.toml"
    file.write_bytes(text.encode("latin-1"))
    monkeypatch.setenv(FILE_VARIABLE, str(file))
    with pytest.raises(InputError):
        load_settings()


def test_a_missing_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FILE_VARIABLE, str(tmp_path / "missing.toml"))
    with pytest.raises(InputError, match="not a file"):
        load_settings()
