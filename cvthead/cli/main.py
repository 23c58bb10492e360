"""The ``cvthead`` command: parses arguments, runs a subcommand, reports errors on one line."""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from typing import NoReturn, TextIO

from cvthead.cli import (
    animate,
    bench,
    data,
    encode,
    evaluate,
    export_official,
    finetune,
    import_official,
    render,
    sweep,
    track,
    train,
)
from cvthead.errors import CVTHeadError, InputError, SeveralFacesError
from cvthead.runtime.threads import one_thread_per_call

COMMANDS = (
    *(encode, render, animate, track, sweep, bench, import_official),
    *(data, train, finetune, export_official, evaluate),
)
FAILED = 2
INTERRUPTED = 130  # what shells report for a command ended by Ctrl-C


class _Parser(argparse.ArgumentParser):
    """Reports wrong arguments like any other wrong input, without the usage text."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message, hint=f"see `{self.prog} --help`")


def parser() -> argparse.ArgumentParser:
    result = _Parser("cvthead", description="Animate a head portrait from one photo.")
    result.add_argument("--version", action="version", version=f"cvthead {version('cvthead')}")
    commands = result.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in COMMANDS:
        module.add_parser(commands)
    # The service is a package of its own above this one, and may be left out.
    if find_spec("service"):
        import_module("service.cli").add_parser(commands)
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        0, or 2 after an error in the input, which is printed on one line of stderr.
    """
    one_thread_per_call()
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = _show_warning
        try:
            args = parser().parse_args(_negatives_joined(sys.argv[1:] if argv is None else argv))
            args.run(args)
        except CVTHeadError as error:
            print(f"cvthead: error: {describe(error)}", file=sys.stderr)
            return FAILED
        except KeyboardInterrupt:
            print("cvthead: interrupted", file=sys.stderr)
            return INTERRUPTED
    return 0


def describe(error: CVTHeadError) -> str:
    """``message; hint`` on one line."""
    message = str(error).rstrip(".")
    if isinstance(error, SeveralFacesError):
        boxes = ", ".join(
            f"{number} at {(left + right) / 2:.0f},{(top + bottom) / 2:.0f}"
            for number, (left, top, right, bottom) in enumerate(error.boxes)
        )
        message = f"{message} (face {boxes})"
    first, _, rest = error.hint.rstrip(".").partition(" ")
    # A sentence's capital goes, a name's (JPEG, WebP) stays.
    first = first.lower() if first[1:].islower() else first
    return " ".join(f"{message}; {first} {rest}".split())


def _negatives_joined(arguments: Sequence[str]) -> list[str]:
    """``--jaw -0.1,0,0`` as ``--jaw=-0.1,0,0``: argparse takes the value for an option."""
    joined: list[str] = []
    for argument in arguments:
        value = re.match(r"-[\d.]", argument)
        if value and joined and re.fullmatch(r"--[a-z-]+", joined[-1]):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    print(f"cvthead: warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
