"""The user's folder with the released files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from cvthead.errors import AssetError
from cvthead.official.manifest import SourceFile, file_sha256

PLACES = "docs/official.md says where each official file comes from"

T = TypeVar("T")


@dataclass
class Release:
    """Remembers what was taken from the folder, and all that is wrong with its files.

    Attributes:
        path: of the folder.
        used: file -> what it was taken for.
        problems: in the order in which they were met.
    """

    path: Path
    used: dict[Path, list[str]] = field(default_factory=dict)
    problems: list[AssetError] = field(default_factory=list)

    def has(self, *names: str) -> bool:
        """Whether there is a file of one of these names, at any depth."""
        return bool(self._all(names))

    def find(self, names: tuple[str, ...], purpose: str) -> Path | None:
        """The file of one of these names, at any depth, the least deep one.

        Returns:
            None, and a problem is noted, if there is none.
        """
        found = self._all(names)
        if not found:
            text = f"{' or '.join(names)} is not in {self.path}; it is needed for {purpose}"
            self.problems.append(AssetError(text, hint=PLACES))
            return None
        chosen = min(found, key=lambda path: (len(path.parts), str(path)))
        self.used.setdefault(chosen, []).append(purpose)
        return chosen

    def read(self, names: tuple[str, ...], purpose: str, read: Callable[[Path], T]) -> T | None:
        """What ``read`` makes of the file of :meth:`find`; None after a problem."""
        path = self.find(names, purpose)
        return self.attempt(lambda: read(path)) if path else None

    def attempt(self, work: Callable[[], T]) -> T | None:
        """What ``work`` returns; None, and a problem is noted, if it raises AssetError."""
        try:
            return work()
        except AssetError as error:
            self.problems.append(error)
            return None

    def refuse(self) -> None:
        """Do nothing if no problem was noted.

        Raises:
            AssetError: the problem, or one that lists them all.
        """
        if len(self.problems) == 1:
            raise self.problems[0]
        if self.problems:
            listed = "\n".join(f"({n}) {problem}" for n, problem in enumerate(self.problems, 1))
            count = len(self.problems)
            raise AssetError(
                f"{count} problems with the files in {self.path}:\n{listed}", hint=PLACES
            )

    def sources(self) -> tuple[SourceFile, ...]:
        return tuple(
            SourceFile(str(path.relative_to(self.path)), file_sha256(path), tuple(purposes))
            for path, purposes in self.used.items()
        )

    def _all(self, names: tuple[str, ...]) -> list[Path]:
        return [path for name in names for path in self.path.rglob(name) if path.is_file()]
