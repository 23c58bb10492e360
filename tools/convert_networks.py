"""Make the networks under ``cvthead/assets`` from the wheels that carry Google's originals.

    pip install tflite onnx ai-edge-litert
    python -m tools.convert_networks --photos ../shared/data/stills/val

Every original is checked against its SHA-256 in ``cvthead/assets/networks.json``, converted, and
run beside LiteRT on what the tracker feeds it for each photo; LiteRT has the selfie network's
custom operator built in, so all four are compared whole. The assets are written if every network
agrees and is byte for byte the recorded one.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
from ai_edge_litert.interpreter import Interpreter
from numpy.typing import NDArray

from cvthead.tracking.blendshapes import LANDMARK_SUBSET
from cvthead.tracking.detector import FaceDetector, anchor_centres, letterbox
from cvthead.tracking.landmarks import FaceLandmarker
from cvthead.tracking.regions import region_of_landmarks
from cvthead.tracking.sessions import RECORD_NAME, network_record
from tools.tflite_to_onnx import convert

ASSETS = Path(__file__).parents[1] / "cvthead" / "assets"
TOLERANCE = 1e-3
DETECTOR, LANDMARKS, BLENDSHAPES, SELFIE = (
    "face_detector.onnx",
    "face_landmarks.onnx",
    "face_blendshapes.onnx",
    "selfie_segmentation.onnx",
)

Image = NDArray[np.uint8]
Batch = NDArray[np.float32]


@dataclass(frozen=True)
class Pair:
    """One network in both runtimes."""

    litert: Interpreter
    onnx: ort.InferenceSession

    @classmethod
    def open(cls, original: bytes, converted: bytes) -> Pair:
        interpreter = Interpreter(model_content=original, num_threads=1)
        interpreter.allocate_tensors()
        return cls(interpreter, ort.InferenceSession(converted, providers=["CPUExecutionProvider"]))

    def difference(self, batch: Batch) -> tuple[float, float]:
        """Largest absolute difference of all outputs, and largest absolute output."""
        self.litert.set_tensor(self.litert.get_input_details()[0]["index"], batch)
        self.litert.invoke()
        details = self.litert.get_output_details()
        # The runtimes may order the outputs differently, but keep their names.
        expected = {d["name"].split(":")[0]: self.litert.get_tensor(d["index"]) for d in details}
        names = [output.name for output in self.onnx.get_outputs()]
        outputs = self.onnx.run(names, {self.onnx.get_inputs()[0].name: batch})
        differences = [
            np.abs(value - expected[name]).max() for name, value in zip(names, outputs, strict=True)
        ]
        return float(max(differences)), float(max(np.abs(value).max() for value in outputs))


def read_original(wheel: Path, entry: dict[str, Any]) -> bytes:
    """Unpack an original; ``path`` leads through archives, each step has its SHA-256."""
    contents = wheel.read_bytes()
    for name, expected in zip(entry["path"], entry["source_sha256"], strict=True):
        contents = zipfile.ZipFile(io.BytesIO(contents)).read(name)
        if hashlib.sha256(contents).hexdigest() != expected:
            raise SystemExit(f"{wheel.name}: {name} is not the recorded file")
    return contents


def find_wheel(package: str, folder: Path) -> Path:
    """The wheel of ``name==version`` in a folder, downloaded into it if absent."""
    pattern = package.replace("-", "_").replace("==", "-") + "-*.whl"
    if not any(folder.glob(pattern)):
        # The selfie wheel exists for some Pythons only; nothing of it is imported.
        target = ["--python-version", "3.11", "--platform", "manylinux_2_28_x86_64"]
        command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary", ":all:"]
        subprocess.run([*command, *target, "--dest", str(folder), package], check=True)
    return next(folder.glob(pattern))


def inputs(image: Image, networks: dict[str, Pair]) -> Iterator[tuple[str, Batch]]:
    """(network, input) for one photo; without a face only detector and selfie network."""
    yield DETECTOR, letterbox(image, 0.0)[0]
    selfie = cv2.resize(image, (256, 256), interpolation=cv2.INTER_AREA).astype(np.float32)
    yield SELFIE, selfie[None] / np.float32(255)
    faces = FaceDetector(networks[DETECTOR].onnx, anchor_centres()).detect(image)
    if not faces:
        return
    landmarker = FaceLandmarker(networks[LANDMARKS].onnx)
    landmarks, _ = landmarker.landmarks(image, faces[0].region())
    cut = region_of_landmarks(landmarks).cut(image, 256).astype(np.float32)
    yield LANDMARKS, cut[None] / np.float32(255)
    yield BLENDSHAPES, landmarks[np.array(LANDMARK_SUBSET), :2].astype(np.float32)[None]


def compare(networks: dict[str, Pair], photos: list[Path]) -> bool:
    """Print the table; True if every network was run and stays within the tolerance."""
    rows: dict[str, list[tuple[float, float]]] = {name: [] for name in networks}
    for photo in photos:
        pixels = cv2.imread(str(photo))
        if pixels is None:
            raise SystemExit(f"{photo} is not an image")
        image = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        for name, batch in inputs(image, networks):
            rows[name].append(networks[name].difference(batch))
    print(f"{'network':26}{'runs':>6}{'largest output':>16}{'largest difference':>20}")
    passed = True
    for name, row in rows.items():
        difference, output = np.array(row or [(np.inf, 0.0)]).max(axis=0)
        passed &= bool(difference < TOLERANCE)
        print(f"{name:26}{len(row):6}{output:16.4f}{difference:20.2e}")
    return passed


def main() -> int:
    parser = argparse.ArgumentParser(description="Convert, check and store the face networks.")
    parser.add_argument("--photos", type=Path, required=True, help="folder of .jpg or .png faces")
    parser.add_argument("--wheels", type=Path, help="folder of downloaded wheels")
    parser.add_argument("--count", type=int, default=60, help="photos to compare on, at most")
    parser.add_argument(
        "--record", action="store_true", help="accept the networks made now as the recorded ones"
    )
    arguments = parser.parse_args()

    photos = sorted(p for p in arguments.photos.iterdir() if p.suffix in (".jpg", ".png"))
    # Evenly spaced, since neighbours in a data set look alike.
    photos = photos[:: -(-len(photos) // arguments.count) or 1]
    record = network_record()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.wheels or Path(temporary)
        originals = {
            name: read_original(find_wheel(entry["package"], folder), entry)
            for name, entry in record.items()
        }
    converted = {name: convert(contents) for name, contents in originals.items()}
    networks = {name: Pair.open(originals[name], converted[name]) for name in record}
    if not compare(networks, photos):
        print(f"a network differs from LiteRT by {TOLERANCE} or more, or was not run")
        return 1
    digests = {name: hashlib.sha256(contents).hexdigest() for name, contents in converted.items()}
    changed = [name for name, digest in digests.items() if digest != record[name]["sha256"]]
    if changed and not arguments.record:
        print(f"not byte for byte the recorded files: {', '.join(changed)}; see --record")
        return 1
    for name, contents in converted.items():
        (ASSETS / name).write_bytes(contents)
        record[name]["sha256"] = digests[name]
    (ASSETS / RECORD_NAME).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
