"""Output that appears whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cvthead.errors import InputError


@contextmanager
def atomic_path(path: Path | str, *, folder: bool = False, replace: bool = False) -> Iterator[Path]:
    """A temporary sibling of ``path``, renamed to it when the block succeeds.

    Whatever ends the block early (also KeyboardInterrupt) removes the temporary file, and a
    file that was already at ``path`` stays as it was. Errors of the block pass unchanged.

    Args:
        path: the file, or with ``folder`` the folder, to write.
        folder: yield a new empty folder instead of the name of a file to create.
        replace: a folder that is already there gives way to the new one once that is complete.
            No system call swaps folders everywhere, so for a moment there is none; what fails
            then brings the old one back.

    Raises:
        InputError: the parent folder does not exist, ``path`` is a folder (with ``folder``: a
            file or, unless ``replace``, a folder that is not empty), or the operating system
            refuses.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise InputError(
            f"{target.parent} is not a folder", hint="Create the output's folder first."
        )
    gives_way = target.is_dir() and (replace or not any(target.iterdir()))
    if (folder and target.exists() and not gives_way) or (not folder and target.is_dir()):
        raise InputError(f"{target} is already there", hint="Choose another name.")
    # A sibling is on the same file system, so that the rename is atomic.
    temporary = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
    try:
        if folder:
            with write_errors(target):
                temporary.mkdir()
        yield temporary
        with write_errors(target):
            if replace and target.is_dir():
                _swap(temporary, target)
                return
            if folder and target.is_dir():
                target.rmdir()
            os.replace(temporary, target)
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)


def _swap(new: Path, old: Path) -> None:
    """The folder ``new`` in the place of ``old``, which is removed."""
    aside = new.with_suffix(".old")
    os.replace(old, aside)
    try:
        os.replace(new, old)
    except BaseException:
        os.replace(aside, old)
        raise
    shutil.rmtree(aside, ignore_errors=True)


@contextmanager
def write_errors(target: Path | str) -> Iterator[None]:
    """Turns what the operating system refuses (no space, no permission) into InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot write {target}: {error.strerror or error}",
            hint="Check the folder's permissions and the free space.",
        ) from error


def write_file(path: Path | str, data: bytes, *, mode: int = 0o666) -> None:
    """Write ``data`` to ``path`` atomically.

    Args:
        mode: permissions of the new file, less the process's umask.

    Raises:
        InputError: see ``atomic_path``.
    """

    def opened(name: str, flags: int) -> int:
        # From the start: a file that is narrowed afterwards could be opened before.
        return os.open(name, flags, mode)

    with (
        atomic_path(path) as temporary,
        write_errors(path),
        open(temporary, "xb", opener=opened) as file,
    ):
        file.write(data)
