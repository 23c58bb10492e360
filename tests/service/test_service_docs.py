"""docs/service.md says what the code does."""

from __future__ import annotations

import re
from pathlib import Path

from documented import DOCS, metrics_table, problems_table, settings_table, tables_in

from service.settings import Settings

SERVICE = Path(__file__).parents[2] / "service"
UNITS = ("_seconds", "_bytes", "_total", "_info")


def check(expected: list[str]) -> None:
    tables = tables_in(DOCS.read_text())
    assert expected in tables, "put this into docs/service.md:\n" + "\n".join(expected)


def test_settings_are_documented() -> None:
    assert all(field.description for field in Settings.model_fields.values())
    check(settings_table())


def test_problem_codes_are_documented() -> None:
    check(problems_table())


def test_metrics_are_documented(tmp_path: Path) -> None:
    check(metrics_table(tmp_path))


def test_metrics_have_base_units_or_count_things(tmp_path: Path) -> None:
    names = [row.split("`")[1] for row in metrics_table(tmp_path)[2:]]
    assert len(names) > 10
    assert not [name for name in names if re.search(r"milli|_ms|_mb|_kb|percent|minutes", name)]
    durations = [name for name in names if "time" in name or "latency" in name]
    assert all(name.endswith(UNITS) for name in durations)


def test_every_setting_is_used() -> None:
    derived = SERVICE / "settings.py"
    code = "\n".join(p.read_text() for p in SERVICE.rglob("*.py") if p != derived)
    own = derived.read_text().split("def on_loopback")[1]
    reads = re.compile(r"(?:settings|self)\.(\w+)")
    used = set(re.findall(r"settings\.(\w+)", code)) | set(reads.findall(own))
    used |= {"open_network"}  # read by the check of the settings themselves
    assert set(Settings.model_fields) - used == set()
