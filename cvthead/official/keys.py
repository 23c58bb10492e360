"""Names and shapes of the released checkpoint's 1,189 tensors, and the check against them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import TYPE_CHECKING

from cvthead.errors import AssetError

if TYPE_CHECKING:  # the import alone has tensors; serving goes without PyTorch
    from torch import Tensor

Shapes = Mapping[str, tuple[int, ...]]


@cache
def released_shapes() -> Shapes:
    """Key -> shape of ``cvthead.pt``'s entry ``model``."""
    text = resources.files("cvthead.official").joinpath("keys.json").read_text("utf-8")
    return MappingProxyType({key: tuple(shape) for key, shape in json.loads(text).items()})


def part(prefix: str) -> Shapes:
    """The keys that start with ``prefix``, without it."""
    shapes = released_shapes()
    return {k.removeprefix(prefix): v for k, v in shapes.items() if k.startswith(prefix)}


def check(name: str, state: Mapping[str, Tensor], expected: Shapes, *, extra: bool = False) -> None:
    """Compare a state dict with what it should hold.

    Args:
        name: of the file, for the message.
        state: key -> tensor.
        expected: key -> shape.
        extra: let further keys pass.

    Raises:
        AssetError: names every missing, extra and mis-shaped key.
    """
    missing = [key for key in expected if key not in state]
    unknown = [key for key in state if key not in expected] if not extra else []
    shapes = {key: tuple(state[key].shape) for key in expected if key in state}
    problems = [f"{key} is missing" for key in missing]
    problems += [f"{key} is unknown" for key in unknown]
    problems += [
        f"{key} has shape {shape}, not {expected[key]}"
        for key, shape in shapes.items()
        if shape != expected[key]
    ]
    if problems:
        raise AssetError(
            f"{name} is not the released file ({len(problems)} differences): "
            + "; ".join(problems),
            hint="download it again from the place that docs/official.md names",
        )
