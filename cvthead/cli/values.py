"""Coefficients as they are written on the command line and in JSON files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvthead.errors import CoefficientsError

# About 50,000 frames; more would only fill the memory.
MAX_BYTES = 100 * 2**20


def read_json(path: Path) -> Any:
    """The contents of a JSON file.

    Raises:
        CoefficientsError: not readable, too large, or not JSON.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CoefficientsError(
                f"{path} is larger than {MAX_BYTES >> 20} MiB", hint="split it into shorter files"
            )
        return json.loads(path.read_bytes())
    except OSError as error:
        raise CoefficientsError(
            f"cannot read {path}: {error.strerror}", hint="check the path"
        ) from error
    except (ValueError, RecursionError) as error:
        raise CoefficientsError(
            f"{path} is not JSON: {error}", hint="correct the file; numbers are written as 0.5"
        ) from error


def vector(name: str, text: str, start: NDArray[np.float32]) -> NDArray[np.float32]:
    """A vector of coefficients from an option's text.

    Args:
        name: for error messages.
        text: all numbers ("0.1,0,..."), some ("0=1.5,3=-2"), or a JSON file (``@file`` or a name
            ending in .json) with a list, or an object of index to number.
        start: (n,) the values of the indices that are not named; tells the length.

    Raises:
        CoefficientsError: no numbers, wrong length, no such index.
    """
    value = _parsed(name, text)
    if isinstance(value, Mapping):
        return with_entries(name, value, start)
    return listed(name, value, len(start))


def weights(name: str, text: str) -> dict[str, float]:
    """Named weights ("jawOpen=0.3,mouthSmileLeft=0.8") or a JSON file with an object of them.

    Raises:
        CoefficientsError: not of this form. The names are not checked here.
    """
    value = _parsed(name, text)
    if not isinstance(value, Mapping):
        raise CoefficientsError(
            f"{name} is not a list of name=number", hint="write for example jawOpen=0.3"
        )
    return {key: number(f"{name} {key}", entry) for key, entry in value.items()}


def listed(name: str, value: object, size: int) -> NDArray[np.float32]:
    """A list of ``size`` numbers as a vector; Controls checks them further."""
    if not isinstance(value, list):
        raise CoefficientsError(f"{name} is not a list", hint=f"write {size} numbers")
    if len(value) != size:
        raise CoefficientsError(
            f"{name} has {len(value)} numbers, expected {size}",
            hint=f"write {size} numbers, or single ones as index=number",
        )
    return np.array([number(f"{name}[{i}]", v) for i, v in enumerate(value)], np.float32)


def with_entries(
    name: str, entries: Mapping[str, object], start: NDArray[np.float32]
) -> NDArray[np.float32]:
    """``start`` with the entries (index -> number) replaced."""
    result = start.copy()
    for key, value in entries.items():
        # The length first: int() refuses thousands of digits with an error of its own.
        if not (key.isdecimal() and len(key) < 10 and int(key) < len(start)):
            raise CoefficientsError(f"{name} has no index {key}", hint=f"use 0 to {len(start) - 1}")
        result[int(key)] = number(f"{name}[{key}]", value)
    return result


def number(name: str, value: object) -> float:
    """A finite number, also one written as text.

    Raises:
        CoefficientsError: it is none.
    """
    try:
        if isinstance(value, bool):
            raise TypeError
        result = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError) as error:
        raise CoefficientsError(
            f"{name} is not a number: {value!r}", hint="write numbers such as 0.5"
        ) from error
    # Above float32 a value would become infinite only later.
    if not abs(result) <= np.finfo(np.float32).max:
        raise CoefficientsError(f"{name} is NaN or infinite", hint="write finite numbers")
    return result


def _parsed(name: str, text: str) -> object:
    """A list of strings, a mapping of strings, or what a JSON file holds."""
    if text.startswith("@") or text.lower().endswith(".json"):
        return read_json(Path(text.removeprefix("@")))
    parts = [part.strip() for part in text.split(",") if part.strip()]
    pairs = [part.split("=", 1) for part in parts]
    if parts and all(len(pair) == 2 for pair in pairs):
        return {key.strip(): value for key, value in pairs}
    if any(len(pair) == 2 for pair in pairs):
        raise CoefficientsError(
            f"{name} mixes single numbers and index=number", hint="use one of the two forms"
        )
    return parts
