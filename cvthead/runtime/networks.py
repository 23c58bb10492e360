"""The preset's two trained networks on onnxruntime: describe once, paint every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from cvthead.deformation import MAX_SHELL_POINTS
from cvthead.errors import AssetError
from cvthead.runtime.mix import mix
from cvthead.runtime.model_folder import DESCRIBE, HINT, PAINT, ModelFolder
from cvthead.runtime.place import Placed, code_size
from cvthead.runtime.sessions import CPU, open_session
from cvthead.runtime.subpixels import unshuffled
from cvthead.runtime.threads import cores
from cvthead.source import Source

MAX_THREADS = 4  # more bring nothing at this size
DESCRIBE_INPUTS = ("source", "points", "clear", "anchor", "hidden")


@dataclass(frozen=True, eq=False)
class Networks:
    """Opened sessions; safe to share between threads.

    Attributes:
        describe_session: source -> descriptor codes.
        paint_session: codes of a splat -> codes of a picture.
        descriptor_size: C.
        splat_size: height and width of the splat, half of the frame's.
        fingerprint: of the trained weights.
        preset: of the model.
        features: fused, or of an ablation; see cvthead.training.config.
    """

    describe_session: ort.InferenceSession
    paint_session: ort.InferenceSession
    descriptor_size: int
    splat_size: int
    fingerprint: str
    preset: str
    features: str

    @property
    def all_seen(self) -> bool:
        """All points count as seen: the ablation with pixel-aligned features alone."""
        return self.features == "pixel-aligned"

    @classmethod
    def load(
        cls,
        path: Path,
        *,
        threads: int | None = None,
        providers: Sequence[str] = CPU,
        encode_niceness: int = 0,
    ) -> Networks:
        """Open the networks of a model folder.

        Args:
            path: the folder.
            threads: of each network; None takes the machine's cores, at most 4.
            providers: see cvthead.runtime.sessions.
            encode_niceness: as cvthead.preset.load_preset has it.

        Raises:
            AssetError: a file is missing, altered, or of another version of cvthead, or
                onnxruntime lacks a provider.
        """
        folder = ModelFolder.load(path)
        count = threads or min(MAX_THREADS, cores())
        describe, paint = (
            open_session(folder.read(name), count, providers, niceness=niceness)
            for name, niceness in ((DESCRIBE, encode_niceness), (PAINT, 0))
        )
        if {each.name for each in describe.get_inputs()} != set(DESCRIBE_INPUTS):
            raise AssetError(
                f"{path} was exported by another version of cvthead",
                hint=HINT,
            )
        _, size, _, channels = paint.get_inputs()[0].shape
        descriptors = channels - code_size(0)
        features = folder.training.get("features", "fused")
        return cls(describe, paint, descriptors, size, folder.fingerprint, folder.preset, features)

    def describe(self, source: Source, hidden: NDArray[np.float32]) -> NDArray[np.uint8]:
        """(P, C) descriptor codes of all points of the layout.

        Args:
            source: the portrait.
            hidden: (P, 3) of cvthead.hidden.
        """
        shell = source.deformation.shell_anchor
        anchor = np.zeros((1, MAX_SHELL_POINTS), np.int64)
        anchor[0, : len(shell)] = shell
        feed = {
            "source": source.network_input[None],
            "points": source.points[None],
            "clear": source.clear[None].astype(np.float32),
            "anchor": anchor,
            "hidden": hidden[None],
        }
        out: NDArray[np.uint8] = self.describe_session.run(None, feed)[0][0]
        return out

    def paint(self, inputs: Sequence[Placed]) -> list[NDArray[np.uint8]]:
        """RGBA (256, 256, 4) of each frame; they may belong to different avatars."""
        codes = np.stack([one.codes for one in inputs])
        portrait = np.stack([unshuffled(one.warped) for one in inputs])
        painted = self.paint_session.run(None, {"splat": codes, "portrait": portrait})[0]
        if self.features == "transformer":
            inputs = [placed.without_lending() for placed in inputs]
        return [mix(one, placed) for one, placed in zip(painted, inputs, strict=True)]
