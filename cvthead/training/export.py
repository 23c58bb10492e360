"""Turn a training checkpoint into the weights that ship.

python -m cvthead.training.export RUN/checkpoint.pt cvthead/assets/open.safetensors RECORDS
"""

from __future__ import annotations

import argparse
import hashlib
from datetime import UTC, datetime
from pathlib import Path

import torch

from cvthead import weights
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.points import PointLayout


def records_hash(folder: Path) -> str:
    """SHA-256 over names and contents of the training records."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.npz")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("records", type=Path, help="what it was trained on, for its hash")
    a = parser.parse_args()
    state = torch.load(a.checkpoint, weights_only=True)
    model = CVTHead(OPEN, MeshHierarchy.load(), PointLayout.of(HeadModel.load()))
    averaged = {
        name.removeprefix("module."): value
        for name, value in state["averaged"].items()
        if name.startswith("module.")
    }
    model.load_state_dict(averaged)
    metadata = {
        "preset": "open",
        "step": str(state["step"]),
        "records_sha256": records_hash(a.records),
        "date": datetime.now(UTC).date().isoformat(),
        "licence": "Apache-2.0",
        "data": "generated people only: clips/train and stills/train",
    }
    weights.save(model, a.output, metadata)
    print(a.output, f"{a.output.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
