"""The imported model's folder: weights, networks and ``model.json``, which vouches for them."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cvthead.errors import AssetError
from cvthead.files import write_file

RECORD = "model.json"
VERSION = 3
PRESET = "official"
NETWORK = "cvthead.safetensors"
PARSING = "face_parsing.safetensors"
HAIR = "hair.safetensors"
DECA = "deca.safetensors"
FLAME = "flame.safetensors"
MESH = "mesh.safetensors"
TABLES = (PARSING, HAIR, DECA, FLAME, MESH)  # what training CVTHead leaves as it is
WEIGHTS = (NETWORK, *TABLES)
# The networks as they are served, made from the weights.
PARSING_ONNX = "face_parsing.onnx"
HAIR_ONNX = "hair.onnx"
DECA_ONNX = "deca.onnx"
DESCRIBE_ONNX = "describe.onnx"
DESCRIBE_INT8_ONNX = "describe_int8.onnx"
UNET_ONNX = "unet.onnx"
UNET_INT8_ONNX = "unet_int8.onnx"
NETWORKS = (PARSING_ONNX, HAIR_ONNX, DECA_ONNX, DESCRIBE_ONNX, UNET_ONNX)
FILES = (*WEIGHTS, *NETWORKS)
# What is served instead of a float network, if its pictures are close enough.
EIGHT_BIT = {UNET_ONNX: UNET_INT8_ONNX, DESCRIBE_ONNX: DESCRIBE_INT8_ONNX}
MIN_PSNR = 40.0  # dB of those pictures to the float ones
HINT = "import the official files again with `cvthead import-official`"
FOLDER_VARIABLE = "CVTHEAD_OFFICIAL"
WEIGHTS_PART = "CVTHead weights and tables (cvthead.pt, data/)"
HEAD_PART = "FLAME head model"


@dataclass(frozen=True)
class Licence:
    """What a part of the official files may be used for. No legal advice: the page decides."""

    part: str
    licence: str
    page: str


LICENCES = (
    Licence(
        WEIGHTS_PART,
        "published without a licence: all rights are the authors'",
        "https://github.com/HowieMa/CVTHead",
    ),
    Licence(
        HEAD_PART,
        "the licence accepted at the download; FLAME 2020: non-commercial research only",
        "https://flame.is.tue.mpg.de/modellicense.html",
    ),
    Licence(
        "DECA encoder",
        "Max Planck licence, non-commercial research only",
        "https://github.com/yfeng95/DECA/blob/master/LICENSE",
    ),
    Licence(
        "ROME hair model and image encoder",
        "non-commercial use only",
        "https://github.com/SamsungLabs/rome",
    ),
    Licence(
        "BiSeNet face parsing",
        "code MIT; trained on CelebAMask-HQ, a data set for non-commercial research",
        "https://github.com/zllrunning/face-parsing.PyTorch",
    ),
)


@dataclass(frozen=True)
class SourceFile:
    """A file that was imported."""

    name: str
    sha256: str
    used_for: tuple[str, ...]


@dataclass(frozen=True)
class Manifest:
    """Checked contents of ``model.json``.

    Attributes:
        folder: where it lies.
        fingerprint: 16 hex digits of all weights; avatars remember it.
        sources: the files it was made from.
        sha256: of each of FILES, and of the 8-bit ones that are there.
        psnr: 8-bit file -> dB of the pictures made with it, and with those before it that are
            served, to the float ones; also where that was too little.
        deformation: False if the network was retrained without hair and shoulders.
    """

    folder: Path
    fingerprint: str
    sources: tuple[SourceFile, ...]
    sha256: Mapping[str, str]
    psnr: Mapping[str, float]
    deformation: bool

    @classmethod
    def load(cls, folder: Path) -> Manifest:
        """Read ``model.json``.

        Raises:
            AssetError: nothing was imported there, or it is malformed.
        """
        path = folder / RECORD
        if not path.is_file():
            raise AssetError(
                f"the official model is not in {folder}",
                hint="import the official files with `cvthead import-official DIR`",
            )
        try:
            record: dict[str, Any] = json.loads(path.read_text("utf-8"))
            if (record["preset"], record["version"]) != (PRESET, VERSION):
                raise ValueError(f"preset {record['preset']!r}, version {record['version']!r}")
            sources = tuple(
                SourceFile(str(s["name"]), str(s["sha256"]), tuple(map(str, s["used_for"])))
                for s in record["sources"]
            )
            sha256 = {name: str(record["sha256"][name]) for name in FILES}
            sha256 |= {
                name: str(record["sha256"][name])
                for name in EIGHT_BIT.values()
                if name in record["sha256"]
            }
            psnr = {str(name): float(value) for name, value in record["psnr"].items()}
            # Networks of earlier releases were all trained with it.
            deformation = bool(record.get("deformation", True))
            fingerprint = str(record["fingerprint"])
            if not re.fullmatch("[0-9a-f]{16}", fingerprint):
                raise ValueError("no fingerprint")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise AssetError(f"{path} is not an imported model: {error!r}", hint=HINT) from error
        return cls(folder, fingerprint, sources, sha256, psnr, deformation)

    @property
    def tables_fingerprint(self) -> str:
        """16 hex digits of all weights but CVTHead's own network: what its training rests on."""
        return _fingerprint(self.sha256, TABLES)

    def checked(self, name: str) -> Path:
        """Path of a file of the import, after comparing its hash.

        Raises:
            AssetError: missing or altered.
        """
        path = self.folder / name
        try:
            found = file_sha256(path)
        except OSError as error:
            raise AssetError(f"{path} is missing", hint=HINT) from error
        if found != self.sha256[name]:
            raise AssetError(f"{path} is not the imported file", hint=HINT)
        return path


def write_manifest(
    folder: Path,
    sources: tuple[SourceFile, ...],
    psnr: Mapping[str, float] | None = None,
    *,
    deformation: bool = True,
) -> None:
    """Write ``model.json`` for the FILES and the 8-bit ones in ``folder``.

    Args:
        folder, sources, psnr, deformation: as Manifest's.
    """
    names = [*FILES, *(name for name in EIGHT_BIT.values() if (folder / name).is_file())]
    sha256 = {name: file_sha256(folder / name) for name in names}
    record = {
        "preset": PRESET,
        "version": VERSION,
        # Of the weights alone: an avatar stays what it is when the networks are exported anew.
        "fingerprint": _fingerprint(sha256, WEIGHTS),
        "sources": [asdict(source) for source in sources],
        "licences": [asdict(licence) for licence in LICENCES],
        "psnr": dict(psnr or {}),
        "deformation": deformation,
        "sha256": sha256,
    }
    write_file(folder / RECORD, (json.dumps(record, indent=2) + "\n").encode())


def _fingerprint(sha256: Mapping[str, str], names: Sequence[str]) -> str:
    digest = hashlib.sha256("".join(sha256[name] for name in names).encode())
    return digest.hexdigest()[:16]


def file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def default_folder() -> Path:
    """Where the import goes and the preset is looked for: CVTHEAD_OFFICIAL, or the user's data."""
    if chosen := os.environ.get(FOLDER_VARIABLE):
        return Path(chosen)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "cvthead" / PRESET
