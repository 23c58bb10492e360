"""Names and shapes of what the released files hold, and the check against them."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvthead.errors import AssetError

Shapes = Mapping[str, tuple[int, ...]]


@cache
def released_shapes() -> Shapes:
    """Key -> shape of the 1,189 tensors of ``cvthead.pt``'s entry ``model``."""
    return _stored("keys.json")


@cache
def deca_detail_shapes() -> Shapes:
    """``entry.key`` -> shape of the networks of ``deca_model.tar`` that CVTHead does not use."""
    return _stored("deca_detail.json")


def _stored(name: str) -> Shapes:
    text = resources.files("cvthead.official").joinpath(name).read_text("utf-8")
    return MappingProxyType({key: tuple(shape) for key, shape in json.loads(text).items()})


def part(prefix: str) -> Shapes:
    """The keys that start with ``prefix``, without it."""
    shapes = released_shapes()
    return {k.removeprefix(prefix): v for k, v in shapes.items() if k.startswith(prefix)}


def differences(
    found: Mapping[str, Any], expected: Shapes, *, extra: bool = False
) -> dict[str, str]:
    """Compare named tables with what there should be.

    Args:
        found: key -> tensor, array or sparse matrix.
        expected: key -> shape.
        extra: let further keys pass.

    Returns:
        What is wrong with each missing, extra and mis-shaped key.
    """
    problems = {key: f"{key} is missing" for key in expected if key not in found}
    if not extra:
        problems |= {key: f"{key} is unknown" for key in found if key not in expected}
    # What is no table at all has no shape either.
    shapes = {key: tuple(getattr(found[key], "shape", ())) for key in expected if key in found}
    problems |= {
        key: f"{key} has shape {shape}, not {expected[key]}"
        for key, shape in shapes.items()
        if shape != expected[key]
    }
    return problems


def table_problems(
    found: Mapping[str, Any],
    expected: Shapes,
    counts: Mapping[str, int],
    *,
    extra: bool = False,
) -> dict[str, str]:
    """As :func:`differences`, of arrays whose numbers are looked at too.

    Args:
        found, expected, extra: as :func:`differences`.
        counts: of what a table of indices points to, by key.

    Returns:
        What is wrong, by key; also NaN, infinity and indices that point outside.
    """
    problems = differences(found, expected, extra=extra)
    for key in [key for key in expected if key not in problems]:
        table = dense(found[key])
        if not np.isfinite(table).all():
            problems[key] = f"{key} holds NaN or infinity"
        elif key in counts and (table.min() < 0 or table.max() >= counts[key]):
            problems[key] = f"{key} points outside 0..{counts[key] - 1}"
    return problems


def dense(value: Any) -> NDArray[Any]:
    """A sparse matrix or an array as an array."""
    return np.asarray(value.toarray() if hasattr(value, "toarray") else value)


def refuse(name: str, problems: Collection[str]) -> None:
    """Do nothing without problems.

    Raises:
        AssetError: names them all.
    """
    if problems:
        count = f"{len(problems)} difference" + "s" * (len(problems) > 1)
        raise AssetError(
            f"{name} is not the released file ({count}): " + "; ".join(problems),
            hint="download it again from the place that docs/official.md names",
        )


def check(name: str, found: Mapping[str, Any], expected: Shapes, *, extra: bool = False) -> None:
    """Compare a file's tables with what it should hold; see :func:`differences`.

    Args:
        name: of the file, for the message.
        found, expected, extra: as :func:`differences`.

    Raises:
        AssetError: names every missing, extra and mis-shaped key.
    """
    refuse(name, differences(found, expected, extra=extra).values())
