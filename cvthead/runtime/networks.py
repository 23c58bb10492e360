"""The preset's two trained networks on onnxruntime: describe once, paint every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from cvthead.deformation import MAX_SHELL_POINTS
from cvthead.runtime.model_folder import DESCRIBE, PAINT, ModelFolder
from cvthead.runtime.place import PLACE_SIZE, Placed
from cvthead.runtime.sessions import open_session
from cvthead.runtime.threads import cores
from cvthead.source import Source

Array = NDArray[np.float32]

MAX_THREADS = 4  # more bring nothing at this size


@dataclass(frozen=True, eq=False)
class Networks:
    """Opened sessions; safe to share between threads.

    Attributes:
        describe_session: source -> descriptors.
        paint_session: splat and warped portrait -> picture.
        row_size: C + 3, values of a descriptor row.
        splat_size: height and width of the splat.
        fingerprint: of the trained weights.
        preset: of the model.
    """

    describe_session: ort.InferenceSession
    paint_session: ort.InferenceSession
    row_size: int
    splat_size: int
    fingerprint: str
    preset: str

    @classmethod
    def load(cls, path: Path, *, threads: int | None = None) -> Networks:
        """Open the networks of a model folder.

        Args:
            path: the folder.
            threads: of each network; None takes the machine's cores, at most 4.

        Raises:
            AssetError: a file is missing or altered.
        """
        folder = ModelFolder.load(path)
        count = threads or min(MAX_THREADS, cores())
        describe, paint = (open_session(folder.read(name), count) for name in (DESCRIBE, PAINT))
        _, size, _, channels = paint.get_inputs()[0].shape
        row_size = channels - 2 + PLACE_SIZE
        return cls(describe, paint, row_size, size, folder.fingerprint, folder.preset)

    def describe(self, source: Source) -> Array:
        """(P, C + 3) descriptor rows of all points of the layout."""
        shell = source.deformation.shell_anchor
        anchor = np.zeros((1, MAX_SHELL_POINTS), np.int64)
        anchor[0, : len(shell)] = shell
        feed = {
            "source": source.network_input[None],
            "points": source.points[None],
            "visible": source.visible[None].astype(np.float32),
            "anchor": anchor,
        }
        out: Array = self.describe_session.run(None, feed)[0][0]
        return out

    def paint(self, inputs: Sequence[Placed]) -> NDArray[np.uint8]:
        """(B, 256, 256, 4) RGBA of B frames, which may belong to different avatars."""
        feed = {
            "splat": np.stack([one.splat for one in inputs]),
            "warped": np.stack([one.warped for one in inputs]),
        }
        out: NDArray[np.uint8] = self.paint_session.run(None, feed)[0]
        for rgba, one in zip(out, inputs, strict=True):
            np.minimum(rgba[..., 3], one.reach, out=rgba[..., 3])
        return out
