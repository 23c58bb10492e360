"""From an image to coefficients and camera: detect, find landmarks, solve."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.coefficients import Array, Coefficients
from cvthead.errors import FaceTooSmallError, FaceTurnedError, NoFaceError, SeveralFacesError
from cvthead.head.model import HeadModel
from cvthead.tracking.landmark_basis import landmark_basis
from cvthead.tracking.networks import Detection, FaceRegion, Networks, region_of_landmarks
from cvthead.tracking.solver import Fit, Solver, rigid_start

Box = tuple[float, float, float, float]

# Below this the landmark network does not recognise what it looks at; its points are then
# plausible but wrong, so they are never used.
PRESENCE_THRESHOLD = 0.5
# Landmarks fit worse and the far side is guessed beyond this yaw.
YAW_WARNING_DEGREES = 60.0
# Outer-eye distance in pixels under which an avatar cannot be made: half of what the network's
# 0.36 m crop of 256 pixels resolves, so a smaller face would be enlarged more than twice.
MINIMUM_EYE_DISTANCE = 32.0
SOURCE_ITERATIONS, DRIVING_ITERATIONS = 10, 4


class FaceTurnedWarning(UserWarning):
    """The head is turned so far that the fit is uncertain."""


@dataclass(frozen=True, eq=False)
class TrackedFace:
    """One face in one image.

    Attributes:
        coefficients: shape, expression and pose; the neck stays straight, both eyes are parallel.
        camera: weak perspective in image pixels.
        landmarks: (478, 3) continuous image pixels, depth in the same unit.
        presence: 0.5..1, the network's belief that this is a face.
        box: left, top, right, bottom of the landmarks in pixels.
        error: mean distance of the fitted landmarks from the found ones, in percent of the
            head's outer-eye distance.
    """

    coefficients: Coefficients
    camera: Camera
    landmarks: NDArray[np.float64]
    presence: float
    box: Box
    error: float

    @property
    def yaw(self) -> float:
        """Degrees about the vertical, positive to the subject's left, within +-180."""
        return _yaw(self.coefficients)


@dataclass(frozen=True, eq=False)
class _Sighting:
    landmarks: NDArray[np.float64]
    presence: float

    @property
    def box(self) -> Box:
        low, high = self.landmarks[:, :2].min(axis=0), self.landmarks[:, :2].max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


@dataclass(frozen=True, eq=False)
class Tracker:
    """Fits the head model to faces in images. Immutable; safe to share between threads."""

    head: HeadModel
    networks: Networks
    solver: Solver

    @classmethod
    def load(cls, head: HeadModel | None = None) -> Self:
        """With the packaged head model and networks, or with another head model.

        Raises:
            AssetError: a file of the installed package is missing or altered.
        """
        head = head or HeadModel.load()
        return cls(head, Networks.load(), Solver.for_basis(landmark_basis(head)))

    def track(
        self,
        image: NDArray[np.uint8],
        *,
        face: int | None = None,
        only_one: bool = False,
        shape: Array | None = None,
        previous: TrackedFace | None = None,
    ) -> TrackedFace:
        """Fit the head model to one face.

        Args:
            image: (H, W, 3) uint8 RGB.
            face: which face, 0 = largest; None also takes the largest.
            only_one: refuse an image with several faces.
            shape: (100,) known identity, for driving frames; None fits it.
            previous: the same face in the frame before. Its landmarks tell where to look, its
                expression is the start, and its shape is kept unless ``shape`` is given. If the
                face is not found there, the whole image is searched.

        Raises:
            ImageError: not an (H, W, 3) uint8 array.
            NoFaceError: no face, or no face number ``face``.
            SeveralFacesError: several faces and ``only_one``; carries their boxes.
            FaceTooSmallError: the identity is to be fitted and the eyes are closer than
                MINIMUM_EYE_DISTANCE pixels.
            FaceTurnedError: something face-like that the landmark network does not recognise:
                profile, covered, or no face after all.

        Warns:
            FaceTurnedWarning: the head is turned by more than YAW_WARNING_DEGREES.
        """
        fit_shape = shape is None and previous is None
        if shape is None and previous is not None:
            shape = previous.coefficients.shape
        sighting = self._follow(image, previous)
        if sighting is None:
            sighting = self._search(image, face, only_one)
        start = self._start(sighting, shape, previous)
        iterations = SOURCE_ITERATIONS if fit_shape else DRIVING_ITERATIONS
        fit = self.solver.solve(
            sighting.landmarks, start, fit_shape=fit_shape, iterations=iterations
        )
        eye_distance = fit.scale * self.solver.basis.eye_distance
        if fit_shape and eye_distance < MINIMUM_EYE_DISTANCE:
            raise FaceTooSmallError(
                f"the eyes are {eye_distance:.0f} pixels apart,"
                f" at least {MINIMUM_EYE_DISTANCE:.0f} are needed",
                hint="Send a larger picture or one taken from nearer.",
            )
        coefficients, camera = self.solver.coefficients(fit)
        yaw = _yaw(coefficients)
        if abs(yaw) > YAW_WARNING_DEGREES:
            warnings.warn(
                f"the head is turned by {abs(yaw):.0f} degrees; the hidden side is a guess",
                FaceTurnedWarning,
                stacklevel=2,
            )
        return TrackedFace(
            coefficients,
            camera,
            sighting.landmarks,
            sighting.presence,
            sighting.box,
            self.solver.error(fit, sighting.landmarks),
        )

    def _start(self, sighting: _Sighting, shape: Array | None, previous: TrackedFace | None) -> Fit:
        start = self.solver.start(sighting.landmarks, shape)
        if previous is None:
            return start
        return rigid_start(
            self.solver.basis,
            sighting.landmarks,
            self.solver.with_face_of(start, previous.coefficients),
        )

    def _follow(self, image: NDArray[np.uint8], previous: TrackedFace | None) -> _Sighting | None:
        """The face where it was in the previous frame, or None if it is gone."""
        if previous is None:
            return None
        region = region_of_landmarks(previous.landmarks)
        sighting = _Sighting(*self.networks.landmarks(image, region))
        return sighting if sighting.presence >= PRESENCE_THRESHOLD else None

    def _search(self, image: NDArray[np.uint8], face: int | None, only_one: bool) -> _Sighting:
        detections = self.networks.detect(image)
        if not detections:
            raise NoFaceError(
                "no face found", hint="Send a picture with one face, seen from the front."
            )
        if face is None and not only_one and (first := self._look(image, detections[0])):
            return first
        sightings = _distinct([s for d in detections if (s := self._look(image, d)) is not None])
        if not sightings:
            raise FaceTurnedError(
                "a face was detected, but its landmarks cannot be found",
                hint="Send a picture in which both eyes and the mouth are visible.",
            )
        if only_one and len(sightings) > 1:
            raise SeveralFacesError(
                f"{len(sightings)} faces found, exactly one was asked for",
                hint="Crop the picture to one face or choose one by its number.",
                boxes=[sighting.box for sighting in sightings],
            )
        number = face or 0
        if not 0 <= number < len(sightings):
            raise NoFaceError(
                f"face number {number} was asked for, the picture shows {len(sightings)}",
                hint=f"Choose a number from 0 to {len(sightings) - 1}.",
            )
        return sightings[number]

    def _look(self, image: NDArray[np.uint8], detection: Detection) -> _Sighting | None:
        """Landmarks of a detected face; the second pass is centred on those of the first."""
        region: FaceRegion = detection.region()
        landmarks, presence = self.networks.landmarks(image, region)
        landmarks, presence = self.networks.landmarks(image, region_of_landmarks(landmarks))
        if presence < PRESENCE_THRESHOLD:
            return None
        return _Sighting(landmarks, presence)


def _distinct(sightings: Sequence[_Sighting]) -> list[_Sighting]:
    """Without the repeats that arise when two detections lead to the same face; by size."""
    kept: list[_Sighting] = []
    for sighting in sorted(sightings, key=lambda s: -_size(s.box)):
        x, y = sighting.landmarks[:, :2].mean(axis=0)
        if not any(b[0] <= x <= b[2] and b[1] <= y <= b[3] for b in (k.box for k in kept)):
            kept.append(sighting)
    return kept


def _size(box: Box) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])


def _yaw(coefficients: Coefficients) -> float:
    rotation = cv2.Rodrigues(coefficients.joint("global").astype(np.float64))[0]
    return float(np.degrees(np.arctan2(rotation[0, 2], rotation[2, 2])))
