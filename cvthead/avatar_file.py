"""Avatar files of either preset: safetensors, written whole, read with distrust."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as save_tensors

from cvthead.errors import AvatarFileError, CoefficientsError

# Four times what the largest avatar needs.
MAX_BYTES = 4 * 2**20


def packed(tensors: Mapping[str, NDArray[Any]], metadata: dict[str, str]) -> bytes:
    """Contents of an avatar file."""
    contiguous = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    return save_tensors(contiguous, metadata=metadata)


@contextmanager
def opened(path: Path | str, kind: str, *, hint: str) -> Iterator[Any]:
    """An avatar file for a ``with`` block that checks and reads it.

    Args:
        path: of the file.
        kind: what it should be, for messages.
        hint: what to do about a file that is not.

    Raises:
        AvatarFileError: missing or too large, and for whatever the block finds wrong.
    """
    try:
        if Path(path).stat().st_size > MAX_BYTES:
            raise ValueError(f"larger than {MAX_BYTES >> 20} MiB")
        with safe_open(str(path), framework="np") as file:
            yield file
    except FileNotFoundError as error:
        raise AvatarFileError(f"{path} does not exist", hint=hint) from error
    except (SafetensorError, OSError, ValueError, CoefficientsError) as error:
        raise AvatarFileError(f"{path} is damaged or not {kind}: {error}", hint=hint) from error
