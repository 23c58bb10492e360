"""The preset's two trained networks on onnxruntime: describe once, paint every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS
from cvthead.deformation import MAX_SHELL_POINTS
from cvthead.runtime.model_folder import DESCRIBE, PAINT, ModelFolder
from cvthead.runtime.sessions import open_session
from cvthead.runtime.splat import EMPTY_DEPTH, splat
from cvthead.runtime.threads import cores
from cvthead.runtime.warp import dense_flow, warp
from cvthead.source import Source

Array = NDArray[np.float32]

MAX_THREADS = 4  # more bring nothing at this size
CLOSING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))  # closes gaps between points
SOFT_EDGE = np.ones((3, 3), np.uint8)
PLACE_SIZE = 3  # a descriptor row's last values: x and y in the portrait, seen


class PaintInput(NamedTuple):
    """What the frame network reads, and how far its result may reach.

    Attributes:
        splat: (s, s, 1 + C + 1).
        warped: (256, 256, 4) uint8.
        reach: (256, 256) uint8, highest alpha; see :func:`reach_of`.
    """

    splat: Array
    warped: NDArray[np.uint8]
    reach: NDArray[np.uint8]


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

    def place(self, points: Array, rows: Array, portrait: NDArray[np.uint8]) -> PaintInput:
        """Splat and warp; see :func:`place`."""
        return place(points, rows, portrait, self.splat_size)

    def paint(self, inputs: Sequence[PaintInput]) -> NDArray[np.uint8]:
        """(B, 256, 256, 4) RGBA of B frames, which may belong to different avatars."""
        feed = {
            "splat": np.stack([one.splat for one in inputs]),
            "warped": np.stack([one.warped for one in inputs]),
        }
        out: NDArray[np.uint8] = self.paint_session.run(None, feed)[0]
        for rgba, one in zip(out, inputs, strict=True):
            np.minimum(rgba[..., 3], one.reach, out=rgba[..., 3])
        return out


def place(points: Array, rows: Array, portrait: NDArray[np.uint8], size: int) -> PaintInput:
    """Splat the rows and carry the portrait's pixels to the driven points.

    Args:
        points: (P, 3) normalised driven projections.
        rows: (P, C + 3) descriptor rows.
        portrait: (256, 256, 4) uint8, see Avatar.
        size: of the splat.
    """
    flowing = rows.copy()
    flowing[:, -PLACE_SIZE:-1] -= points[:, :2]
    image = splat(points, flowing, size)
    seen = np.ascontiguousarray(image[..., -1])
    flow = dense_flow(image[..., -PLACE_SIZE:-1], seen, CROP_PIXELS)
    kept = np.concatenate([image[..., :-PLACE_SIZE], image[..., -1:]], axis=-1)
    warped = warp(portrait, flow)
    return PaintInput(kept, warped, reach_of(image[..., 0], warped))


def reach_of(depth: Array, warped: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(256, 256) uint8: 255 where points lie or the carried portrait shows the person.

    Beyond the edge of a portrait nothing is known. Training pictures end there as well, so the
    network was never told to leave it empty.
    """
    drawn = (depth > EMPTY_DEPTH).astype(np.uint8) * 255
    closed = cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, CLOSING)
    size = warped.shape[0]
    points = cv2.resize(closed, (size, size), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.maximum(points, cv2.dilate(warped[..., 3], SOFT_EDGE)), np.uint8)
