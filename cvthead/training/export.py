"""Turn a training checkpoint into the model folder that ships.

    python -m cvthead.training.export RUN/checkpoint.pt MODEL RECORDS

The folder holds ``weights.safetensors`` (half precision, what fine-tuning starts from), the
networks ``describe.onnx`` and ``paint.onnx`` made from it, and ``model.json``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvthead import weights
from cvthead.camera import CROP_PIXELS
from cvthead.errors import InputError
from cvthead.files import write_errors
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.model.light_unet import PIXEL_SIZE, PORTRAIT_SIZE
from cvthead.model.pixel_aligned import COLOUR_SIZE
from cvthead.points import SEEN, PointLayout
from cvthead.runtime.ghosts import point_owners
from cvthead.runtime.mix import LOGIT_RANGE
from cvthead.runtime.model_folder import DESCRIBE, PAINT, WEIGHTS, write_record
from cvthead.runtime.networks import DESCRIBE_INPUTS
from cvthead.runtime.place import Placed, place
from cvthead.runtime.seams import outline_rim
from cvthead.source import portrait_pixels
from cvthead.training.checkpoint import UNKNOWN, averaged, read
from cvthead.training.dataset import PairDataset
from cvthead.training.onnx_export import export_describe, export_paint
from cvthead.training.quantise import feed, quantise
from cvthead.training.records import records_hash

CALIBRATION, HELD_OUT = 32, 16
SPLAT_SIZE = CROP_PIXELS // OPEN.unet_unshuffle
SEED = 2  # of the calibration samples
NOTES = ("licence", "data")
PATHS = {"data", "labels", "model", "tables"}  # settings that say nothing elsewhere
DESCRIPTOR_SHARE = 0.9999  # the rest is clipped to the largest code
FEATURE_SHARE = 0.9999


def averaged_model(state: Mapping[str, Any]) -> CVTHead:
    """The averaged weights of a checkpoint of the open preset.

    Raises:
        InputError: it is of another preset.
    """
    config = state.get("config", {})
    if config.get("preset", "open") != "open":
        raise InputError(
            f"a run of the preset {config['preset']} is not exported by this",
            hint="paper has no runtime; `cvthead export-official` exports official",
        )
    network = replace(OPEN, features=config.get("features", "fused"))
    model = CVTHead(network, MeshHierarchy.load(), PointLayout.of(HeadModel.load()))
    model.load_state_dict(averaged(state))
    if network.features == "transformer":
        forget_portrait(model)
    return model


@torch.no_grad()
def forget_portrait(model: CVTHead) -> None:
    """Make the frame network of this ablation ignore what it was trained without: the runtime
    carries the portrait, and says what it sees, to every network."""
    stem, last = model.unet.stem[0], model.unet.to_image
    assert isinstance(stem, torch.nn.Conv2d)
    assert last.bias is not None
    stem.weight[:, 1 + model.config.descriptor_size] = 0  # seen
    stem.weight[:, -PORTRAIT_SIZE * model.unet.unshuffle**2 :] = 0
    last.weight[:, PIXEL_SIZE:] = 0
    last.weight[4], last.bias[4] = 0, -LOGIT_RANGE  # the gate


def samples(
    records: Path, count: int, *, deform: bool, all_seen: bool
) -> tuple[PointLayout, list[dict[str, NDArray[Any]]]]:
    """Training samples to calibrate on."""
    head = HeadModel.load()
    layout = PointLayout.of(head)
    dataset = PairDataset(
        records,
        head,
        layout,
        size=CROP_PIXELS,
        seed=SEED,
        samples=count,
        deform=deform,
        all_seen=all_seen,
    )
    batches = (dataset[index] for index in range(count))
    return layout, [{name: value.numpy() for name, value in b.items()} for b in batches]


def descriptor_range(model: CVTHead, calibration: Sequence[dict[str, NDArray[Any]]]) -> Tensor:
    """(C,) absolute value that nearly all descriptors stay below."""
    with torch.inference_mode():
        rows = [
            model.describe(*(torch.from_numpy(sample[n])[None] for n in DESCRIBE_INPUTS))[0]
            for sample in calibration
        ]
    largest = np.quantile(torch.cat(rows).abs().numpy(), DESCRIPTOR_SHARE, axis=0)
    largest[:COLOUR_SIZE] = 1  # cvthead.runtime.lend takes them for bytes
    return torch.from_numpy(np.maximum(largest, 1e-3).astype(np.float32))


def frames(
    describe: Path, layout: PointLayout, calibration: Sequence[dict[str, NDArray[Any]]]
) -> list[Placed]:
    """Inputs of the frame network: a driven view of each sample."""
    session = ort.InferenceSession(str(describe), providers=["CPUExecutionProvider"])
    out = []
    for sample in calibration:
        codes = session.run(None, {name: sample[name][None] for name in DESCRIBE_INPUTS})[0][0]
        at = np.concatenate([sample["points"][:, :2], sample["seen"][0][:, None]], axis=1)
        owners = point_owners(at, at[:, 2] == SEEN)
        portrait = portrait_pixels(sample["source"])
        rim, driven = outline_rim(portrait), sample["driven"][0]
        out.append(place(layout, driven, at, owners, rim, codes, portrait, SPLAT_SIZE))
    return out


def feature_range(network: Path, placed: Sequence[Placed]) -> float:
    """Largest of the last features of a frame network exported with range 1."""
    network_with = onnx.load(str(network))
    last = [node for node in network_with.graph.node if node.op_type == "Concat"][-1]
    name = last.input[0]
    network_with.graph.output.append(onnx.ValueInfoProto(name=name))
    session = ort.InferenceSession(
        network_with.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    largest = [np.quantile(session.run([name], feed(each))[0], FEATURE_SHARE) for each in placed]
    return float(np.max(largest)) / 255


def export(
    checkpoint: Path, output: Path, records: Path, notes: Mapping[str, str]
) -> dict[str, str]:
    """Write the model folder; returns the training record that ``model.json`` holds.

    Args:
        checkpoint: of a run of the open preset.
        output: folder, made if needed.
        records: what it was trained on: hash, calibration.
        notes: for the training record, such as data and licence.

    Raises:
        InputError: not such a checkpoint, or no records.
        AssetError: a network differs from torch, or its 8-bit version from it.
    """
    state = read(checkpoint)
    model = averaged_model(state)
    config = state.get("config", {})
    deform = config.get("deformation", True)
    training = {
        "step": str(state["step"]),
        "seed": str(config.get("seed", UNKNOWN)),
        "began_with": state.get("began_with", UNKNOWN),
        "settings": json.dumps({name: config[name] for name in sorted(config.keys() - PATHS)}),
        "features": model.config.features,
        "deformation": str(deform).lower(),
        "records_sha256": records_hash(records),
        "date": datetime.now(UTC).date().isoformat(),
        **notes,
    }
    with write_errors(output):
        output.mkdir(parents=True, exist_ok=True)
    weights.save(model, output / WEIGHTS, {"preset": "open"} | training)
    # The networks are made of the weights as stored, in half precision.
    fingerprint = weights.load_into(model, output / WEIGHTS)
    model.eval().requires_grad_(False)
    layout, calibration = samples(
        records,
        CALIBRATION + HELD_OUT,
        deform=deform,
        all_seen=model.config.features == "pixel-aligned",
    )
    largest = descriptor_range(model, calibration[:CALIBRATION])
    export_describe(model, largest, output / DESCRIBE)
    placed = frames(output / DESCRIBE, layout, calibration)
    if model.config.features == "transformer":
        placed = [each.without_lending() for each in placed]
    with tempfile.TemporaryDirectory() as folder:
        exact = Path(folder) / PAINT
        export_paint(model, largest, 1.0, exact)
        export_paint(model, largest, feature_range(exact, placed[:CALIBRATION]), exact)
        decibels = quantise(exact, output / PAINT, placed[:CALIBRATION], placed[CALIBRATION:])
    training["quantisation_psnr"] = f"{decibels:.1f} dB"
    write_record(output, "open", fingerprint, training)
    return training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path, help="model folder")
    parser.add_argument("records", type=Path, help="what it was trained on: hash, calibration")
    for name in NOTES:
        parser.add_argument(f"--{name}", metavar="TEXT", help="for the training record")
    a = parser.parse_args()
    notes = {name: text for name in NOTES if (text := getattr(a, name)) is not None}
    for name, value in export(a.checkpoint, a.output, a.records, notes).items():
        print(f"{name:20s} {value}")
    for path in sorted(a.output.iterdir()):
        path.chmod(0o644)
        print(f"{path.name:20s} {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
