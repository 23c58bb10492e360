"""Tables of docs/service.md as the code says them."""

from __future__ import annotations

import re
from pathlib import Path

from cvthead.cache import AvatarCache
from service.metrics import CacheCollector, Metrics
from service.problem_codes import PROBLEMS
from service.settings import PREFIX, Settings

DOCS = Path(__file__).parents[2] / "docs" / "service.md"


def settings_table() -> list[str]:
    rows = ["| variable | default | meaning |", "| --- | --- | --- |"]
    for name, field in Settings.model_fields.items():
        shown = f"`{str(field.default).lower()}`" if field.default not in (None, ()) else ""
        rows.append(f"| `{PREFIX}{name.upper()}` | {shown} | {field.description} |")
    return rows


def problems_table() -> list[str]:
    rows = ["| code | status | when | what to do |", "| --- | --- | --- | --- |"]
    for code, kind in PROBLEMS.items():
        rows.append(f"| `{code}` | {kind.status} | {kind.meaning} | {kind.hint} |")
    return rows


def metrics_table(folder: Path) -> list[str]:
    metrics = Metrics()
    metrics.registry.register(CacheCollector(AvatarCache(folder)))
    rows = ["| metric | type | labels | meaning |", "| --- | --- | --- | --- |"]
    for family in metrics.registry.collect():
        if not family.name.startswith("cvthead_"):
            continue  # the process's own, named by the library
        suffix = {"counter": "_total", "info": "_info"}.get(family.type, "")
        labels = ", ".join(f"`{label}`" for label in label_names(metrics, family.name))
        kind, text = family.type, family.documentation
        rows.append(f"| `{family.name}{suffix}` | {kind} | {labels} | {text} |")
    return rows


def label_names(metrics: Metrics, name: str) -> list[str]:
    found = [m for m in vars(metrics).values() if getattr(m, "_name", "") == name]
    return [str(label) for metric in found for label in metric._labelnames]


def tables_in(text: str) -> list[list[str]]:
    return [block.splitlines() for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)]
