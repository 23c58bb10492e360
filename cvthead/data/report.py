"""What data preparation kept, and what it dropped and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

from cvthead.data.layout import SPLITS, Item
from cvthead.data.tracking import Outcome

NOT_MEDIA = "not a video or still"


@dataclass(frozen=True)
class Report:
    """Counts of a prepared folder; ``report.json`` holds its fields.

    Attributes:
        files: of the input.
        kept: by split: records, frames and identities.
        dropped: files by reason.
        frames_dropped: sampled frames by reason, of kept and dropped files.
        dropped_files: every dropped file and its reason.
    """

    files: int
    kept: Mapping[str, Mapping[str, int]]
    dropped: Mapping[str, int]
    frames_dropped: Mapping[str, int]
    dropped_files: Mapping[str, str]

    @classmethod
    def of(
        cls, items: Sequence[Item], others: Sequence[PurePath], outcomes: Mapping[str, Outcome]
    ) -> Report:
        """From the outcome of every item, by key, and the files that are no items."""
        kept: dict[str, dict[str, int]] = {}
        for split in SPLITS:
            mine = [i for i in items if i.split == split and outcomes[i.key].dropped is None]
            kept[split] = {
                "records": len(mine),
                "frames": sum(outcomes[item.key].frames for item in mine),
                "identities": len({item.identity for item in mine}),
            }
        files = {path.as_posix(): NOT_MEDIA for path in others}
        frames: Counter[str] = Counter()
        for item in items:
            outcome = outcomes[item.key]
            frames.update(outcome.frames_dropped)
            if outcome.dropped is not None:
                files[item.file.as_posix()] = outcome.dropped
        reasons = dict(Counter(files.values()).most_common())
        return cls(len(items) + len(others), kept, reasons, dict(frames.most_common()), files)

    def table(self) -> str:
        """For people."""
        lines = [f"{'':24s}{'records':>9s}{'frames':>9s}{'identities':>12s}"]
        for split, count in self.kept.items():
            lines.append(
                f"{split:24s}{count['records']:9d}{count['frames']:9d}{count['identities']:12d}"
            )
        for title, counts in (("files", self.dropped), ("frames", self.frames_dropped)):
            if counts:
                lines.append(f"{title} dropped")
                lines += [f"  {reason:22s}{count:9d}" for reason, count in counts.items()]
        return "\n".join(lines)
