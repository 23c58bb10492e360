"""All tables of a run as one Markdown text and one JSON object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cvthead.evaluation.table import Table, plain


@dataclass(frozen=True)
class Report:
    """What a run found.

    Attributes:
        about: sentences on data and protocol.
        sections: heading -> tables.
        absent: heading -> why it has no table.
        seconds: that each part took.
    """

    about: Sequence[str]
    sections: Mapping[str, Sequence[Table]]
    absent: Mapping[str, str]
    seconds: Mapping[str, float]

    def markdown(self) -> str:
        """Headings, captions and tables, to be pasted as they are."""
        blocks = [*self.about]
        for heading, tables in self.sections.items():
            if tables:
                blocks += [f"## {heading}", *(table.markdown() for table in tables)]
        blocks += [f"{heading}: absent, {reason}." for heading, reason in self.absent.items()]
        took = ", ".join(f"{part} {seconds / 60:.1f}" for part, seconds in self.seconds.items())
        return "\n\n".join([*blocks, f"Minutes taken: {took}."]) + "\n"

    def json(self) -> dict[str, Any]:
        """The same figures as plain JSON types; absent and NaN become null."""
        tables = {table.key: table.json() for group in self.sections.values() for table in group}
        facts = {"absent": self.absent, "seconds": self.seconds}
        return plain({"about": self.about, "tables": tables} | facts)  # type: ignore[no-any-return]
