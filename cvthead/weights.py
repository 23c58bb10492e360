"""Trained weights: one float16 safetensors file per preset, and their fingerprint."""

from __future__ import annotations

import hashlib
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from cvthead.errors import AssetError

FINGERPRINT_DIGITS = 16


def fingerprint(tensors: dict[str, Tensor]) -> str:
    """Hex digest of names, shapes and values; engine files and file layout do not matter."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name]
        digest.update(f"{name}{tuple(value.shape)}{value.dtype}".encode())
        digest.update(value.contiguous().numpy().tobytes())
    return digest.hexdigest()[:FINGERPRINT_DIGITS]


def load_into(model: nn.Module, path: Path) -> str:
    """Load weights strictly and return their fingerprint.

    Raises:
        AssetError: file missing or damaged, or keys and shapes that do not fit the model.
    """
    hint = "reinstall cvthead"
    try:
        with safe_open(str(path), framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise AssetError(f"cannot read the weights {path}: {error}", hint=hint) from error
    try:
        model.load_state_dict({name: value.float() for name, value in tensors.items()})
    except RuntimeError as error:
        raise AssetError(f"{path} does not fit the model: {error}", hint=hint) from error
    return fingerprint(tensors)


def save(model: nn.Module, path: Path, metadata: dict[str, str]) -> None:
    """Store the model's weights in half precision."""
    tensors = {
        name: value.half().contiguous() if value.is_floating_point() else value.contiguous()
        for name, value in model.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    save_file(tensors, path, metadata=metadata)
