"""Is it the same person? Cosine similarity of face embeddings (CSIM), made comparable.

The raw cosine says little: an embedder may give strangers .8. So it is normalised: 0 is the
median of different people, 1 that of two frames of one clip, both measured in the same run.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.errors import AssetError
from cvthead.evaluation.picture_networks import PictureNetwork, as_batch
from cvthead.evaluation.shots import Image
from cvthead.tracking.landmarks68 import landmarks68
from cvthead.tracking.tracker import TrackedFace

Vector = NDArray[np.float64]
Embed = Callable[[Image, TrackedFace], Vector]
"""Unit-length embedding of a tracked face in a picture (H, W, 3)."""

DLIB_MODEL = "face_recognition_models/models/dlib_face_recognition_resnet_model_v1.dat"
DLIB_CHIP, DLIB_PADDING = 150, 0.25  # what the network was trained on
# Eyes, nose and mouth corners in the 112 x 112 crop of ArcFace (Deng et al., 2019).
ARCFACE = np.array(
    [
        [38.2946, 51.6963],
        [73.5318, 51.5014],
        [56.0252, 71.7366],
        [41.5493, 92.3655],
        [70.7299, 92.2041],
    ]
)
ARCFACE_PIXELS = 112


@dataclass(frozen=True)
class Scale:
    """Medians of the raw cosine: of two frames of one clip, and of different people."""

    same: float
    different: float

    @classmethod
    def of(cls, same: Sequence[float], people: Sequence[Vector]) -> Scale:
        """From cosines within clips and one embedding of each of two or more people."""
        different = [float(a @ b) for a, b in combinations(people, 2)]
        return cls(float(np.median(same)), float(np.median(different)))

    def normalised(self, cosine: float) -> float:
        return (cosine - self.different) / (self.same - self.different)


def dlib_embedder() -> Embed:
    """dlib's ResNet (King, 2017; CC0), from the wheels ``dlib-bin`` and
    ``face-recognition-models``. No loss of the training uses it.

    Raises:
        AssetError: one of them is not installed.
    """
    try:
        dlib: Any = importlib.import_module("dlib")
        # The package itself imports pkg_resources, which newer setuptools no longer have.
        package = importlib.metadata.distribution("face-recognition-models")
    except (ImportError, importlib.metadata.PackageNotFoundError) as error:
        raise AssetError(
            f"CSIM needs {error.name or error}",
            hint='install with pip install "cvthead[evaluate]"',
        ) from error
    network = dlib.face_recognition_model_v1(str(package.locate_file(DLIB_MODEL)))

    def embed(image: Image, face: TrackedFace) -> Vector:
        points = [
            dlib.point(round(x), round(y)) for x, y in landmarks68(face.landmarks)[:, :2].tolist()
        ]
        box = dlib.rectangle(*(round(side) for side in face.box))
        found = dlib.full_object_detection(box, points)
        chip = dlib.get_face_chip(np.ascontiguousarray(image), found, DLIB_CHIP, DLIB_PADDING)
        return unit(np.array(network.compute_face_descriptor(chip)))

    return embed


def onnx_embedder(path: Path) -> Embed:
    """A network of the user's that takes faces aligned as ArcFace's, 112 x 112.

    Raises:
        InputError: as PictureNetwork.load.
    """
    network = PictureNetwork.load(path)

    def embed(image: Image, face: TrackedFace) -> Vector:
        return unit(network(as_batch(arcface_crop(image, face)[None]))[0].astype(np.float64))

    return embed


def arcface_crop(image: Image, face: TrackedFace) -> Image:
    """(112, 112, 3) the face with eyes, nose and mouth at ArcFace's places."""
    points = landmarks68(face.landmarks)[:, :2].astype(np.float64)
    eyes = points[36:42].mean(axis=0), points[42:48].mean(axis=0)
    five = np.stack([*eyes, points[30], points[48], points[54]])
    # Both counted from the first pixel's centre.
    matrix = cv2.estimateAffinePartial2D(five - 0.5, ARCFACE, method=cv2.LMEDS)[0]
    size = (ARCFACE_PIXELS, ARCFACE_PIXELS)
    return cv2.warpAffine(image, matrix, size, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)


def unit(vector: Vector) -> Vector:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
