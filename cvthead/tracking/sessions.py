"""Verified loading of the packaged ONNX networks."""

from __future__ import annotations

import hashlib
import json
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from cvthead.errors import AssetError, ImageError
from cvthead.runtime.sessions import open_session

RECORD_NAME = "networks.json"


def assets() -> Traversable:
    """The directory of the packaged networks."""
    return files("cvthead") / "assets"


def network_record() -> dict[str, dict[str, Any]]:
    """File name of every packaged network -> source and SHA-256 of both files.

    Raises:
        AssetError: the record is missing or unreadable.
    """
    try:
        record: dict[str, dict[str, Any]] = json.loads((assets() / RECORD_NAME).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise _broken(RECORD_NAME, "missing or unreadable") from error
    return record


def open_network(name: str, *, threads: int = 1) -> ort.InferenceSession:
    """Check a packaged network against its recorded SHA-256 and open it on the CPU.

    These networks are so small that a second thread costs more than it brings; callers that
    want throughput should run several sessions.

    Args:
        name: file name in ``cvthead/assets``, for example ``"face_detector.onnx"``.
        threads: intra-operator threads, at least 1.

    Raises:
        AssetError: the file is missing, or its contents are not the recorded ones.
    """
    try:
        contents = (assets() / name).read_bytes()
    except OSError as error:
        raise _broken(name, "missing") from error
    entry = network_record().get(name)
    if entry is None or hashlib.sha256(contents).hexdigest() != entry["sha256"]:
        raise _broken(name, "not the recorded file")
    return open_session(contents, threads)


def run(session: ort.InferenceSession, batch: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Outputs of a network with a single input, in the order of the graph."""
    outputs: list[NDArray[np.float32]] = session.run(None, {session.get_inputs()[0].name: batch})
    return outputs


def check_image(image: NDArray[np.uint8]) -> None:
    """Raise ImageError unless ``image`` is a non-empty (H, W, 3) uint8 array."""
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ImageError(
            f"expected an (H, W, 3) uint8 RGB image, got {image.dtype} {image.shape}",
            hint="Decode the picture with cvthead.images.decode_image.",
        )


def _broken(name: str, what: str) -> AssetError:
    return AssetError(f"asset {name} is {what}", hint="Reinstall cvthead.")
