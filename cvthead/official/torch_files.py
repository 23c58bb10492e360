"""Reads PyTorch checkpoints as data: tensors, containers and numbers, nothing that runs."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cvthead.errors import AssetError
from cvthead.official.unpickle import ALLOWED, DAMAGE, HINT

# A checkpoint may note a loss as a NumPy scalar; it is read by the same inert stand-ins.
NUMPY_SCALARS = [
    (ALLOWED[name], name)
    for name in (
        "numpy.core.multiarray.scalar",
        "numpy._core.multiarray.scalar",
        "numpy.dtype",
        "_codecs.encode",
    )
]


def load(path: Path) -> Any:
    """Whatever ``torch.save`` stored, on the CPU.

    Raises:
        AssetError: unreadable, damaged, or it holds more than tensors, containers and numbers.
    """
    try:
        with torch.serialization.safe_globals(NUMPY_SCALARS):  # type: ignore[arg-type]
            return torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise AssetError(f"cannot read {path}: {error.strerror}", hint=HINT) from error
    except pickle.UnpicklingError as error:
        raise AssetError(f"{path} is refused: {_reason(error)}", hint=HINT) from error
    except (RuntimeError, *DAMAGE) as error:
        raise AssetError(f"{path} is damaged: {_reason(error)}", hint=HINT) from error


def load_state(path: Path, entry: str | None = None) -> dict[str, Tensor]:
    """A state dict: the whole file, or one entry of the dict it holds.

    Raises:
        AssetError: as :func:`load`, or there is no state dict.
    """
    stored = load(path)
    if entry is None:
        return named_tensors(str(path), stored)
    return named_tensors(
        f"entry {entry!r} of {path}", stored.get(entry) if isinstance(stored, Mapping) else None
    )


def named_tensors(place: str, stored: object) -> dict[str, Tensor]:
    """A state dict, checked.

    Raises:
        AssetError: it is none; names what in it is no tensor.
    """
    if not isinstance(stored, Mapping):
        raise AssetError(f"{place} holds no named tensors", hint=HINT)
    others = [
        str(key)
        for key, value in stored.items()
        if not (isinstance(key, str) and isinstance(value, Tensor))
    ]
    if others:
        raise AssetError(f"{place} holds no named tensors under {', '.join(others)}", hint=HINT)
    return dict(stored)


def load_tensor(path: Path) -> Tensor:
    """A file with a single tensor.

    Raises:
        AssetError: as :func:`load`, or it holds something else.
    """
    stored = load(path)
    if not isinstance(stored, Tensor):
        raise AssetError(f"{path} holds no tensor", hint=HINT)
    return stored


def _reason(error: Exception) -> str:
    """What is wrong, without PyTorch's advice to load without any check."""
    text = str(error)
    for mark in ("GLOBAL ", "Unsupported global: GLOBAL "):
        if mark in text:
            return f"it names {text.split(mark, 1)[1].split()[0]}, which is not a tensor type"
    _, _, text = text.rpartition("WeightsUnpickler error:")
    return text.strip().splitlines()[0] if text.strip() else type(error).__name__
