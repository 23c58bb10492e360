"""Person mask: MediaPipe's general selfie segmentation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from cvthead.tracking.sessions import check_image, open_network, run

INPUT_PIXELS = 256


@dataclass(frozen=True)
class PersonSegmenter:
    session: ort.InferenceSession

    @classmethod
    def load(cls, *, threads: int = 1) -> Self:
        """Raises AssetError if the packaged network is missing or altered."""
        return cls(open_network("selfie_segmentation.onnx", threads=threads))

    def person_mask(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(H, W) float32 mask of an (H, W, 3) uint8 RGB image: 0 background .. 1 person.

        The network sees the whole image squeezed to a square, as in its training.

        Raises:
            ImageError: the array is no such image.
        """
        check_image(image)
        height, width = image.shape[:2]
        small = _resized(image, INPUT_PIXELS, INPUT_PIXELS).astype(np.float32)
        mask = run(self.session, small[None] / np.float32(255))[0][0, :, :, 0]
        clipped: NDArray[np.float32] = np.clip(_resized(mask, width, height), 0, 1)
        return clipped


def _resized(array: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    shrinks = width < array.shape[1] or height < array.shape[0]
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(array, (width, height), interpolation=interpolation)
