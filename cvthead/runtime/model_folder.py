"""A folder with one trained model: what the preset loads, and what fine-tuning writes."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from cvthead.errors import AssetError
from cvthead.files import write_file

WEIGHTS = "weights.safetensors"
DESCRIBE = "describe.onnx"
PAINT = "paint.onnx"
RECORD = "model.json"
HINT = "reinstall cvthead, or write the folder again with cvthead.training.export"


@dataclass(frozen=True)
class ModelFolder:
    """Checked names and hashes of a model's files.

    Attributes:
        path: the folder.
        preset: that the model belongs to.
        fingerprint: 16 hex digits of the trained weights; avatars remember it.
        training: date, data and steps, for people.
        sha256: of each network file.
    """

    path: Path
    preset: str
    fingerprint: str
    training: dict[str, str]
    sha256: dict[str, str]

    @classmethod
    def load(cls, path: Path) -> ModelFolder:
        """Read ``model.json``.

        Raises:
            AssetError: missing or malformed.
        """
        try:
            record: dict[str, Any] = json.loads((path / RECORD).read_text("utf-8"))
            folder = cls(
                path,
                str(record["preset"]),
                str(record["fingerprint"]),
                {str(k): str(v) for k, v in record["training"].items()},
                {str(k): str(v) for k, v in record["sha256"].items()},
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise AssetError(f"{path} is not a model folder: {error!r}", hint=HINT) from error
        if not re.fullmatch("[0-9a-f]{16}", folder.fingerprint):
            raise AssetError(f"{path / RECORD} has no fingerprint", hint=HINT)
        return folder

    def read(self, name: str) -> bytes:
        """A network file, checked against its hash.

        Raises:
            AssetError: missing or altered.
        """
        try:
            data = (self.path / name).read_bytes()
        except OSError as error:
            raise AssetError(f"{self.path / name} is missing", hint=HINT) from error
        if hashlib.sha256(data).hexdigest() != self.sha256.get(name):
            raise AssetError(f"{self.path / name} is not the recorded file", hint=HINT)
        return data


def packaged(preset: str) -> Path:
    """The folder that ships with the package."""
    return Path(str(resources.files("cvthead").joinpath("assets", preset)))


def write_record(path: Path, preset: str, fingerprint: str, training: dict[str, str]) -> None:
    """Write ``model.json`` for the network files in ``path``."""
    record = {
        "preset": preset,
        "fingerprint": fingerprint,
        "training": training,
        "sha256": {
            name: hashlib.sha256((path / name).read_bytes()).hexdigest()
            for name in (DESCRIBE, PAINT)
        },
    }
    write_file(path / RECORD, (json.dumps(record, indent=2) + "\n").encode())
