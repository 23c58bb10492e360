"""Turn a training checkpoint into the model folder that ships.

    python -m cvthead.training.export RUN/checkpoint.pt cvthead/assets/open RECORDS

The folder holds ``weights.safetensors`` (half precision, what fine-tuning starts from), the
networks ``describe.onnx`` and ``paint.onnx`` made from it, and ``model.json``.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from datetime import UTC, datetime
from pathlib import Path

import onnxruntime as ort
import torch

from cvthead import weights
from cvthead.camera import CROP_PIXELS
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.points import PointLayout
from cvthead.runtime.model_folder import DESCRIBE, PAINT, WEIGHTS, write_record
from cvthead.runtime.place import place
from cvthead.source import portrait_pixels
from cvthead.training.dataset import PairDataset
from cvthead.training.onnx_export import export_describe, export_paint
from cvthead.training.quantise import Feed, quantise

CALIBRATION, HELD_OUT = 32, 16
SPLAT_SIZE = CROP_PIXELS // OPEN.unet_unshuffle
DESCRIBE_INPUTS = ("source", "points", "visible", "anchor")
SEED = 2  # of the calibration samples


def records_hash(folder: Path) -> str:
    """SHA-256 over names and contents of the training records."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.npz")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def averaged_model(checkpoint: Path) -> tuple[CVTHead, int]:
    """The averaged weights of a training run and their step."""
    state = torch.load(checkpoint, weights_only=True)
    model = CVTHead(OPEN, MeshHierarchy.load(), PointLayout.of(HeadModel.load()))
    averaged = {
        name.removeprefix("module."): value
        for name, value in state["averaged"].items()
        if name.startswith("module.")
    }
    model.load_state_dict(averaged)
    return model, state["step"]


def frame_inputs(describe: Path, records: Path, count: int) -> list[Feed]:
    """Inputs of the frame network for driven views of training records."""
    head = HeadModel.load()
    layout = PointLayout.of(head)
    dataset = PairDataset(records, head, layout, size=CROP_PIXELS, seed=SEED, samples=count)
    session = ort.InferenceSession(str(describe), providers=["CPUExecutionProvider"])
    feeds: list[Feed] = []
    for index in range(count):
        sample = {name: value.numpy() for name, value in dataset[index].items()}
        inputs = {name: sample[name][None] for name in DESCRIBE_INPUTS}
        rows = session.run(None, inputs)[0][0]
        portrait = portrait_pixels(sample["source"])
        placed = place(layout, sample["driven"][0], rows, portrait, SPLAT_SIZE, CROP_PIXELS)
        feeds.append({"splat": placed.splat[None], "warped": placed.warped[None]})
    return feeds


def export(checkpoint: Path, output: Path, records: Path) -> dict[str, str]:
    """Write the model folder; returns the training record that ``model.json`` holds.

    Raises:
        AssetError: a network differs from torch, or its 8-bit version from it.
    """
    output.mkdir(parents=True, exist_ok=True)
    model, step = averaged_model(checkpoint)
    training = {
        "step": str(step),
        "records_sha256": records_hash(records),
        "date": datetime.now(UTC).date().isoformat(),
        "licence": "Apache-2.0",
        "data": "generated people only: clips/train and stills/train",
    }
    weights.save(model, output / WEIGHTS, {"preset": "open"} | training)
    # The networks are made of the weights as stored, in half precision.
    fingerprint = weights.load_into(model, output / WEIGHTS)
    model.eval().requires_grad_(False)
    export_describe(model, output / DESCRIBE)
    with tempfile.TemporaryDirectory() as folder:
        exact = Path(folder) / PAINT
        export_paint(model, exact)
        feeds = frame_inputs(output / DESCRIBE, records, CALIBRATION + HELD_OUT)
        decibels = quantise(exact, output / PAINT, feeds[:CALIBRATION], feeds[CALIBRATION:])
    training["quantisation_psnr"] = f"{decibels:.1f} dB"
    write_record(output, "open", fingerprint, training)
    return training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path, help="model folder")
    parser.add_argument("records", type=Path, help="what it was trained on: hash, calibration")
    a = parser.parse_args()
    for name, value in export(a.checkpoint, a.output, a.records).items():
        print(f"{name:20s} {value}")
    for path in sorted(a.output.iterdir()):
        path.chmod(0o644)
        print(f"{path.name:20s} {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
