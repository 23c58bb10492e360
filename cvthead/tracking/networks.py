"""The four face networks behind the tracker, opened once and shared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from cvthead.tracking.blendshapes import BLENDSHAPE_NAMES, BlendshapeNetwork
from cvthead.tracking.detector import Detection, FaceDetector
from cvthead.tracking.landmarks import FaceLandmarker
from cvthead.tracking.regions import FaceRegion, region_of_landmarks
from cvthead.tracking.segmentation import PersonSegmenter

__all__ = [
    "BLENDSHAPE_NAMES",
    "Detection",
    "FaceRegion",
    "Networks",
    "region_of_landmarks",
]


@dataclass(frozen=True)
class Networks:
    """MediaPipe's face networks on ONNX Runtime; safe to call from several threads.

    Images are (H, W, 3) uint8 RGB; image coordinates are continuous pixels, the centre of the
    first pixel is 0.5. Every method raises ImageError for an array that is no such image.
    """

    detector: FaceDetector
    landmarker: FaceLandmarker
    segmenter: PersonSegmenter
    blendshape_network: BlendshapeNetwork

    @classmethod
    def load(cls, *, threads: int = 1) -> Self:
        """Open the packaged networks, ``threads`` CPU threads each.

        Raises:
            AssetError: a packaged network is missing or altered.
        """
        return cls(
            FaceDetector.load(threads=threads),
            FaceLandmarker.load(threads=threads),
            PersonSegmenter.load(threads=threads),
            BlendshapeNetwork.load(threads=threads),
        )

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """All faces, largest first; empty if there is none."""
        return self.detector.detect(image)

    def landmarks(
        self, image: NDArray[np.uint8], region: FaceRegion
    ) -> tuple[NDArray[np.float64], float]:
        """(478, 3) landmarks in pixels and the presence 0..1; see FaceLandmarker.landmarks."""
        return self.landmarker.landmarks(image, region)

    def person_mask(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(H, W) float32: 0 background .. 1 person."""
        return self.segmenter.person_mask(image)

    def blendshapes(self, landmarks: NDArray[np.floating]) -> NDArray[np.float32]:
        """(52,) scores 0..1 in the order of BLENDSHAPE_NAMES, from (478, 2 or more) landmarks."""
        return self.blendshape_network.blendshapes(landmarks)
