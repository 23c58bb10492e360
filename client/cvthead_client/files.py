"""Files that appear whole or not at all."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from cvthead_client.errors import CVTHeadClientError

ARCHIVES = {".zip": "application/zip", ".mp4": "video/mp4"}


def archive_type(path: Path | str) -> str:
    """The media type for a batch's file.

    Raises:
        CVTHeadClientError: another ending than .zip or .mp4.
    """
    kind = ARCHIVES.get(Path(path).suffix.lower())
    if kind is None:
        raise CVTHeadClientError(f"cannot write {path}", hint="use the ending .zip or .mp4")
    return kind


@contextmanager
def complete_file(path: Path | str) -> Iterator[Callable[[bytes], object]]:
    """Write ``path`` through the function that is yielded; an error leaves no file behind.

    Raises:
        CVTHeadClientError: the file cannot be written.
    """
    target = Path(path)
    try:
        with tempfile.NamedTemporaryFile(
            dir=target.parent, prefix=f".{target.name}.", delete=False
        ) as file:
            temporary = Path(file.name)
            try:
                yield file.write
                file.close()
                temporary.chmod(0o644)
                temporary.replace(target)
            finally:
                temporary.unlink(missing_ok=True)
    except OSError as error:
        raise CVTHeadClientError(
            f"cannot write {path}: {error.strerror or error}", hint="choose another output"
        ) from error
