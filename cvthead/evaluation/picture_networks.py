"""Networks that a user brings for LPIPS, FID, CSIM and IQA, as ONNX files.

ONNX, because it carries the architecture too and nothing in it is code that runs on loading.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from cvthead.errors import InputError
from cvthead.runtime.sessions import open_session
from cvthead.runtime.threads import cores

Batch = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PictureNetwork:
    """Takes batches (B, 3, H, W) of RGB in [-1, 1], float32, and returns (B, D)."""

    path: Path
    session: ort.InferenceSession

    @classmethod
    def load(cls, path: Path, *, inputs: int = 1) -> PictureNetwork:
        """Open a network.

        Args:
            inputs: batches it takes; two for a distance.

        Raises:
            InputError: no such file, no ONNX network, or with other inputs.
        """
        try:
            session = open_session(path.read_bytes(), cores())
        except Exception as error:  # onnxruntime's classes have no common base
            raise InputError(
                f"{path} cannot be opened as a network", hint="export it as ONNX"
            ) from error
        if len(session.get_inputs()) != inputs:
            raise InputError(
                f"{path} has {len(session.get_inputs())} inputs, expected {inputs}",
                hint="see docs/evaluation.md for what each network takes and gives",
            )
        return cls(path, session)

    def __call__(self, *batches: Batch) -> NDArray[np.float32]:
        """(B, D), whatever shape the network gives each picture.

        Raises:
            InputError: the network does not take pictures of this size, or returns no row for
                each picture.
        """
        names = [one.name for one in self.session.get_inputs()]
        fed = [np.ascontiguousarray(batch, dtype=np.float32) for batch in batches]
        rows = []
        try:
            # Many exports have a batch size of 1.
            for pictures in zip(*fed, strict=True):
                feeds = {name: one[None] for name, one in zip(names, pictures, strict=True)}
                rows.append(np.asarray(self.session.run(None, feeds)[0], np.float32).reshape(-1))
        except Exception as error:  # as above
            raise InputError(
                f"{self.path} refuses a batch of shape {fed[0][:1].shape}: {error}",
                hint="see docs/evaluation.md for what each network takes and gives",
            ) from error
        return np.stack(rows)


def as_batch(pictures: NDArray[np.uint8]) -> Batch:
    """(B, H, W, 3) uint8 -> (B, 3, H, W) in [-1, 1]."""
    return np.ascontiguousarray(pictures.transpose(0, 3, 1, 2), np.float32) / np.float32(127.5) - 1
