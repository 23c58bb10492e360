"""Face detection: BlazeFace, short range (Bazarevsky et al., 2019)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from cvthead.tracking.regions import ENLARGEMENT, FaceRegion
from cvthead.tracking.sessions import check_image, open_network, run

INPUT_PIXELS = 128
# (side of the feature map, anchors per cell): strides 8 and 16, square anchors of size 1.
ANCHOR_GRIDS = ((16, 2), (8, 6))
SCORE_THRESHOLD = 0.5
OVERLAP_THRESHOLD = 0.3
# A face that fills the picture is larger than any the network knows; a black frame around the
# picture, of this share of its longer side, makes the face small enough.
RETRY_MARGINS = (0.5, 1.0)
RETRY_SCORE_THRESHOLD = 0.4


@dataclass(frozen=True)
class Detection:
    """One face.

    Attributes:
        box: left, top, right, bottom in continuous image pixels; may reach beyond the image.
        score: 0..1.
        keypoints: (6, 2) pixels: right eye, left eye, nose tip, mouth, right and left ear tragion
            (the subject's right and left).
    """

    box: tuple[float, float, float, float]
    score: float
    keypoints: NDArray[np.float64]

    @property
    def area(self) -> float:
        """Square pixels."""
        left, top, right, bottom = self.box
        return (right - left) * (bottom - top)

    def region(self) -> FaceRegion:
        """The square for the first pass of the landmark network."""
        left, top, right, bottom = self.box
        x, y = self.keypoints[1] - self.keypoints[0]
        size = max(right - left, bottom - top) * ENLARGEMENT
        return FaceRegion((left + right) / 2, (top + bottom) / 2, size, float(np.arctan2(y, x)))


@dataclass(frozen=True)
class FaceDetector:
    session: ort.InferenceSession
    anchors: NDArray[np.float64]

    @classmethod
    def load(cls, *, threads: int = 1) -> Self:
        """Raises AssetError if the packaged network is missing or altered."""
        return cls(open_network("face_detector.onnx", threads=threads), anchor_centres())

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """All faces of an (H, W, 3) uint8 RGB image, largest first; empty if there is none.

        Raises:
            ImageError: the array is no such image.
        """
        check_image(image)
        found = self._pass(image, 0.0, SCORE_THRESHOLD)
        for margin in RETRY_MARGINS:
            if found:
                break
            found = self._pass(image, margin, RETRY_SCORE_THRESHOLD)
        return sorted(found, key=lambda detection: -detection.area)

    def _pass(self, image: NDArray[np.uint8], margin: float, threshold: float) -> list[Detection]:
        batch, zoom, shift = letterbox(image, margin)
        regressors, logits = run(self.session, batch)
        scores = 1 / (1 + np.exp(-np.clip(logits[0, :, 0].astype(np.float64), -80, 80)))
        sure = np.flatnonzero(scores > threshold)
        # Every row: box centre, box size, six keypoints; all but the size relative to the anchor.
        pairs = regressors[0, sure].astype(np.float64).reshape(-1, 8, 2)
        anchors = self.anchors[sure, None] * INPUT_PIXELS
        centre, half = pairs[:, :1] + anchors, pairs[:, 1:2] / 2
        points = np.concatenate([centre - half, centre + half, pairs[:, 2:] + anchors], axis=1)
        return [
            _detection(score, (merged - shift) / zoom)
            for score, merged in _merge_overlapping(scores[sure], points)
        ]


def anchor_centres() -> NDArray[np.float64]:
    """(896, 2) centres in 0..1 of the network's input, in the order of its outputs."""
    grids = []
    for side, per_cell in ANCHOR_GRIDS:
        centres = (np.arange(side) + 0.5) / side
        y, x = np.meshgrid(centres, centres, indexing="ij")
        grids.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), per_cell, axis=0))
    return np.concatenate(grids)


def _detection(score: float, points: NDArray[np.float64]) -> Detection:
    (left, top), (right, bottom) = points[:2].tolist()
    return Detection((left, top, right, bottom), score, points[2:])


def letterbox(
    image: NDArray[np.uint8], margin: float
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """Network input (1, 128, 128, 3) in -1..1; zoom and shift: input = image * zoom + shift."""
    height, width = image.shape[:2]
    scale = INPUT_PIXELS / (max(height, width) * (1 + 2 * margin))
    size = np.array([max(1, round(width * scale)), max(1, round(height * scale))])
    left, top = (INPUT_PIXELS - size) // 2
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(image, (int(size[0]), int(size[1])), interpolation=interpolation)
    canvas = np.full((1, INPUT_PIXELS, INPUT_PIXELS, 3), -1.0, dtype=np.float32)
    canvas[0, top : top + size[1], left : left + size[0]] = small.astype(np.float32) / 127.5 - 1
    return canvas, size / np.array([width, height]), np.array([left, top], dtype=np.float64)


def _merge_overlapping(
    scores: NDArray[np.float64], points: NDArray[np.float64]
) -> list[tuple[float, NDArray[np.float64]]]:
    """Weighted non-maximum suppression: average the overlapping candidates by their score.

    Args:
        scores: (K,).
        points: (K, 8, 2): the box's two corners, then the keypoints.

    Returns:
        Best score and (8, 2) mean points of every group, best first.
    """
    merged = []
    left = np.argsort(-scores, kind="stable")
    while left.size:
        best = left[0]
        overlap = _intersection_over_union(points[best, :2], points[left, :2])
        overlap[0] = 1.0  # a degenerate box must still leave the list
        group = left[overlap > OVERLAP_THRESHOLD]
        weights = scores[group] / scores[group].sum()
        merged.append((float(scores[best]), np.tensordot(weights, points[group], axes=1)))
        left = left[overlap <= OVERLAP_THRESHOLD]
    return merged


def _intersection_over_union(
    box: NDArray[np.float64], boxes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(2, 2) against (K, 2, 2) corners -> (K,)."""
    low, high = np.maximum(box[0], boxes[:, 0]), np.minimum(box[1], boxes[:, 1])
    common = np.prod(np.clip(high - low, 0, None), axis=1)
    areas = np.prod(boxes[:, 1] - boxes[:, 0], axis=1)
    union = np.prod(box[1] - box[0]) + areas - common
    shares: NDArray[np.float64] = common / np.maximum(union, 1e-9)
    return shares
