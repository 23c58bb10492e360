"""State dicts of frozen networks that users bring for the loss."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from cvthead.errors import InputError


def load_state(path: Path, what: str) -> dict[str, Tensor]:
    """A state dict from a .safetensors file or one of ``torch.save``; nothing in it is run.

    Args:
        path: the file.
        what: for error messages, such as "VGG-19".

    Raises:
        InputError: no such file, or not a state dict.
    """
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(
            f"there is no {what} file {path}",
            hint="these weights are yours to bring, see docs/training.md",
        ) from error
    except Exception as error:  # a damaged file stops the restricted unpickler in any way
        raise InputError(
            f"{path} is not a readable state dict",
            hint="store tensors alone, with torch.save or as safetensors",
        ) from error
    if not isinstance(state, Mapping) or not all(isinstance(v, Tensor) for v in state.values()):
        raise InputError(f"{path} is not a state dict", hint="store model.state_dict()")
    return dict(state)


def fill(network: nn.Module, state: Mapping[str, Tensor], path: Path, what: str) -> None:
    """Load weights strictly and freeze the network.

    Raises:
        InputError: other keys or shapes than the network's.
    """
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        raise InputError(
            f"{path} is not a {what}: {first}", hint="see docs/training.md for the key names"
        ) from error
    network.eval().requires_grad_(False)
