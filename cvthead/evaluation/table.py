"""One table of figures, as Markdown and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

ABSENT = "absent"


@dataclass(frozen=True)
class Table:
    """Rows of figures under one caption.

    Attributes:
        key: name in the JSON report.
        caption: one sentence or more of Markdown above the table.
        columns: title -> format of the figures.
        rows: title -> one figure per column; None where it could not be measured.
        first: title of the first column.
        detail: more figures for the JSON report alone.
    """

    key: str
    caption: str
    columns: Mapping[str, str]
    rows: Mapping[str, Sequence[float | None]]
    first: str = "method"
    detail: Mapping[str, Any] = field(default_factory=dict)

    def markdown(self) -> str:
        """Caption and table."""
        lines = [
            "| " + " | ".join([self.first, *self.columns]) + " |",
            "| " + " | ".join(["---"] * (1 + len(self.columns))) + " |",
        ]
        for title, figures in self.rows.items():
            cells = [
                shown(figure, form)
                for figure, form in zip(figures, self.columns.values(), strict=True)
            ]
            lines.append("| " + " | ".join([title, *cells]) + " |")
        return self.caption + "\n\n" + "\n".join(lines)

    def json(self) -> dict[str, Any]:
        """Caption, rows and detail as plain JSON types; NaN becomes null."""
        rows = {
            title: dict(zip(self.columns, figures, strict=True))
            for title, figures in self.rows.items()
        }
        return plain({"caption": self.caption, "rows": rows, **self.detail})  # type: ignore[no-any-return]


def shown(figure: float | None, form: str) -> str:
    if figure is None:
        return ABSENT
    return "-" if math.isnan(figure) else format(figure, form)


def plain(value: Any) -> Any:
    """Dictionaries and lists of JSON's own types."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
