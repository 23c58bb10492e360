"""The 478 face landmarks (Kartynnik et al., 2019; irises: Ablavatski et al., 2020)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from cvthead.tracking.regions import FaceRegion
from cvthead.tracking.sessions import check_image, open_network, run

INPUT_PIXELS = 256
LANDMARKS = 478


@dataclass(frozen=True)
class FaceLandmarker:
    session: ort.InferenceSession

    @classmethod
    def load(cls, *, threads: int = 1) -> Self:
        """Raises AssetError if the packaged network is missing or altered."""
        return cls(open_network("face_landmarks.onnx", threads=threads))

    def landmarks(
        self, image: NDArray[np.uint8], region: FaceRegion
    ) -> tuple[NDArray[np.float64], float]:
        """Landmarks of the face in a region of an (H, W, 3) uint8 RGB image.

        Returns:
            (478, 3): x and y in continuous image pixels (x right, y down), depth in the same unit,
            0 near the centre of the head and smaller nearer to the camera, along the axis of the
            untilted camera; and the presence 0..1 of a face in the region.

        Raises:
            ImageError: the array is no such image.
        """
        check_image(image)
        cut = region.cut(image, INPUT_PIXELS).astype(np.float32)
        points, presence = run(self.session, cut[None] / np.float32(255))[:2]
        local = points.reshape(LANDMARKS, 3).astype(np.float64)
        matrix = region.to_image(INPUT_PIXELS)
        landmarks = np.empty_like(local)
        landmarks[:, :2] = local[:, :2] @ matrix[:, :2].T + matrix[:, 2]
        landmarks[:, 2] = local[:, 2] * (region.size / INPUT_PIXELS)
        return landmarks, float(1 / (1 + np.exp(-float(presence.ravel()[0]))))
