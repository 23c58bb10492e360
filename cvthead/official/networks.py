"""The imported networks on onnxruntime, and FLAME."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from cvthead.errors import AssetError
from cvthead.official.flame import Flame
from cvthead.official.manifest import (
    DECA_ONNX,
    DESCRIBE_ONNX,
    EIGHT_BIT,
    FLAME,
    HAIR_ONNX,
    HINT,
    PARSING_ONNX,
    UNET_ONNX,
    Manifest,
)
from cvthead.runtime.sessions import CPU, open_session
from cvthead.runtime.threads import cores

Precision = Literal["int8", "float32"]
Array = NDArray[np.float32]

# Driving frames are tracked by DECA; the other networks only encode.
EVERY_FRAME = (DECA_ONNX, UNET_ONNX)
# A portrait's pass takes hundreds of megabytes, which the frames after it do not need.
GIVE_BACK = ("memory.enable_memory_arena_shrinkage", "cpu:0")


@dataclass(frozen=True, eq=False)
class Network:
    """An opened ONNX file; safe to share between threads.

    Attributes:
        session: of onnxruntime.
        keeps_memory: for the next pass; False gives it back after each.
    """

    session: ort.InferenceSession
    keeps_memory: bool

    def __call__(self, *inputs: Array) -> list[Array]:
        """All outputs for a batch of one; the inputs in the file's order."""
        names = (each.name for each in self.session.get_inputs())
        options = ort.RunOptions()
        if not self.keeps_memory:
            options.add_run_config_entry(*GIVE_BACK)
        feed = dict(zip(names, inputs, strict=True))
        out: list[Array] = self.session.run(None, feed, options)
        return out

    @property
    def channels(self) -> int:
        """Of a channels-last input."""
        return int(self.session.get_inputs()[0].shape[-1])


@dataclass(frozen=True, eq=False)
class OfficialNetworks:
    """Everything with weights.

    Attributes:
        manifest: of the import.
        flame: the head model's tables.
        parsing: (1, 3, 256, 256) RGB in [-1, 1] -> (1, 19, 256, 256) logits.
        hair: the same -> (1, 60) coefficients and (1, 5023, 3) offsets in metres.
        deca: (1, 3, 224, 224) RGB in [0, 1] -> (1, 236) codes.
        describe: (1, 4, 256, 256) RGB in [-1, 1] and mask, (1, 5023, 3) projections
            -> (1, 5023, 32) descriptors.
        unet: (1, 256, 256, channels) splat -> (1, 256, 256, 4) RGB before tanh, mask before
            sigmoid.
        precision: file -> of each network that has an 8-bit form; the others are float32.
    """

    manifest: Manifest
    flame: Flame
    parsing: Network
    hair: Network
    deca: Network
    describe: Network
    unet: Network
    precision: Mapping[str, Precision]

    @classmethod
    def load(
        cls,
        folder: Path,
        *,
        precision: Precision = "int8",
        threads: int | None = None,
        providers: Sequence[str] = CPU,
        encode_niceness: int = 0,
    ) -> OfficialNetworks:
        """Load an imported model.

        Args:
            folder: of the import.
            precision: "int8" serves the 8-bit U-Net and image encoder where the import found
                them close enough to float; "float32" never does.
            threads: of each network; None takes the machine's cores.
            providers: see cvthead.runtime.sessions.
            encode_niceness: as cvthead.preset.load_preset has it.

        Raises:
            AssetError: nothing was imported there; a file is missing, altered or does not fit; or
                onnxruntime lacks a provider.
        """
        manifest = Manifest.load(folder)
        chosen: dict[str, Precision] = {
            name: precision if small in manifest.sha256 else "float32"
            for name, small in EIGHT_BIT.items()
        }
        try:
            flame = Flame(**load_file(manifest.checked(FLAME)))
        except (SafetensorError, TypeError) as error:
            raise AssetError(f"{folder} does not fit this version: {error}", hint=HINT) from error
        count = threads or cores()

        def opened(name: str, *, keeps_memory: bool = False) -> Network:
            served = EIGHT_BIT[name] if chosen.get(name) == "int8" else name
            niceness = 0 if name in EVERY_FRAME else encode_niceness
            path = str(manifest.checked(served))
            session = open_session(path, count, providers, niceness=niceness)
            return Network(session, keeps_memory)

        return cls(
            manifest,
            flame,
            opened(PARSING_ONNX),
            opened(HAIR_ONNX),
            opened(DECA_ONNX, keeps_memory=True),
            opened(DESCRIBE_ONNX),
            opened(UNET_ONNX, keeps_memory=True),
            chosen,
        )


def picture_array(picture: NDArray[np.uint8]) -> Array:
    """(h, w, 3) uint8 RGB -> (1, 3, h, w) in [-1, 1], as the released code normalises."""
    scaled = picture.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255)
    return np.ascontiguousarray((scaled - np.float32(0.5)) / np.float32(0.5))


def foreground(logits: Array) -> Array:
    """(b, 19, h, w) of the parsing -> (b, 1, h, w) of 0 and 1: any class but background."""
    return np.asarray(logits[:, 1:].max(axis=1, keepdims=True) > logits[:, :1], np.float32)
