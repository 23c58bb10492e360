"""Fit of head-model coefficients and a weak-perspective camera to 2D face landmarks.

Gauss-Newton on the maximum of the posterior: landmark residuals in metres on the face with
robust (Student-like) weights, against Gaussian priors on shape, expression, jaw and gaze. The
landmarks' errors are strongly correlated, so 478 of them count as ``EFFECTIVE_LANDMARKS``
independent ones; without that the data would drown every prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.coefficients import EXPRESSION_SIZE, SHAPE_SIZE, Coefficients
from cvthead.tracking.landmark_basis import LandmarkBasis

Array = NDArray[np.float32]

EFFECTIVE_LANDMARKS = 150.0
# Squared normalised residual at which a landmark starts to lose weight.
ROBUST_SCALE = 9.0
# Prior standard deviations (radians) and limits. Limits are anatomical with a margin.
JAW_OPENING_SIGMA, JAW_SIDEWAYS_SIGMA, GAZE_SIGMA = 0.25, 0.03, 0.25
JAW_OPENING_LIMITS, JAW_SIDEWAYS_LIMIT, GAZE_LIMIT = (-0.03, 0.62), 0.12, 0.6
# Unknowns: log scale, 2 translation, 3 rotation, 2 jaw, 2 gaze, expression[, shape].
RIGID, JAW, GAZE, EXPRESSION = 6, slice(6, 8), slice(8, 10), slice(10, 10 + EXPRESSION_SIZE)
SHAPE = slice(EXPRESSION.stop, EXPRESSION.stop + SHAPE_SIZE)
_EYES = (1, 2)  # rows of LandmarkBasis.weights


@dataclass(frozen=True, eq=False)
class Fit:
    """Solver state: the head turned by ``rotation`` about its origin, then scaled and shifted.

    Attributes:
        scale: pixels per metre. translation: (2,) pixels, y up. rotation: (3, 3).
        jaw: (2,) opening and sideways angle. gaze: (2,) pitch and yaw of both eyes; radians.
        expression: (50,). shape: (100,).
    """

    scale: float
    translation: Array
    rotation: Array
    jaw: Array
    gaze: Array
    expression: Array
    shape: Array


def _rotation(pitch: float, yaw: float) -> tuple[Array, Array]:
    """Rotation (3, 3) of the axis-angle (pitch, yaw, 0) and its derivatives (2, 3, 3)."""
    matrix, jacobian = cv2.Rodrigues(np.array([pitch, yaw, 0.0], np.float64))
    return matrix.astype(np.float32), jacobian[:2].reshape(2, 3, 3).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Landmarks of one state, before the global rotation, and what the Jacobian needs."""

    points: Array  # (3, N)
    angles: Array  # (4, 3, N) derivative by jaw opening, jaw sideways, gaze pitch, gaze yaw
    jaw_turn: Array  # (3, 3) R_jaw - I


def _geometry(basis: LandmarkBasis, fit: Fit) -> _Geometry:
    identity = np.eye(3, dtype=np.float32)
    joints = basis.joints + basis.joint_shape @ fit.shape + basis.joint_expression @ fit.expression
    jaw, jaw_derivative = _rotation(*fit.jaw)
    eye, eye_derivative = _rotation(*fit.gaze)
    jaw_turn, eye_turn = jaw - identity, eye - identity
    features = np.concatenate([jaw_turn.ravel(), eye_turn.ravel(), eye_turn.ravel()])
    rest = basis.template + basis.shape @ fit.shape + basis.expression @ fit.expression
    rest += basis.pose @ features

    arms = [rest - joints[2 + k][:, None] for k in range(3)]
    points = rest + basis.weights[0] * (jaw_turn @ arms[0])
    for k in _EYES:
        points += basis.weights[k] * (eye_turn @ arms[k])

    angles = np.empty((4, *rest.shape), np.float32)
    for k, derivative in enumerate(jaw_derivative):
        corrective = basis.pose[:, :, :9] @ derivative.ravel()
        angles[k] = corrective + basis.weights[0] * (derivative @ arms[0] + jaw_turn @ corrective)
    for k, derivative in enumerate(eye_derivative):
        corrective = basis.pose[:, :, 9:] @ np.tile(derivative.ravel(), 2)
        angles[2 + k] = corrective
        for eye_index in _EYES:
            angles[2 + k] += basis.weights[eye_index] * (derivative @ arms[eye_index])
    return _Geometry(points, angles, jaw_turn)


def _linear_columns(rows: Array, jaw_turn: Array, linear: Array, swung: Array) -> Array:
    """Projected basis (2, N, K): ``rows (I + w (R_jaw - I)) basis`` for ``rows`` (2, 3)."""
    size = linear.shape[1:]
    flat = rows @ linear.reshape(3, -1) + (rows @ jaw_turn) @ swung.reshape(3, -1)
    return np.asarray(flat.reshape(2, *size), np.float32)


def rigid_start(basis: LandmarkBasis, landmarks: NDArray[np.floating], start: Fit) -> Fit:
    """``start`` with scale, rotation and translation replaced by the weighted Procrustes fit
    to the landmarks' three coordinates (478, 3); the depth only serves as a start."""
    source = _geometry(basis, start).points.astype(np.float64)
    target = landmarks.T * np.array([[1.0], [-1.0], [-1.0]])
    weight = basis.precision.astype(np.float64) ** 2
    weight /= weight.sum()
    source_mean, target_mean = source @ weight, target @ weight
    source, target = source - source_mean[:, None], target - target_mean[:, None]
    u, singular, vt = np.linalg.svd((target * weight) @ source.T)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float(singular @ signs) / float((source**2).sum(0) @ weight)
    translation = target_mean - scale * rotation @ source_mean
    return replace(
        start,
        scale=scale,
        rotation=rotation.astype(np.float32),
        translation=translation[:2].astype(np.float32),
    )


@dataclass(frozen=True, eq=False)
class Solver:
    """Least-squares fit of one head model; build once with ``Solver.for_basis``."""

    basis: LandmarkBasis
    swung_shape: Array  # jaw weight x (shape basis - its motion of the jaw joint)
    swung_expression: Array

    @classmethod
    def for_basis(cls, basis: LandmarkBasis) -> Solver:
        jaw_weight = basis.weights[0][:, None]
        return cls(
            basis,
            jaw_weight * (basis.shape - basis.joint_shape[2][:, None]),
            jaw_weight * (basis.expression - basis.joint_expression[2][:, None]),
        )

    def start(self, landmarks: NDArray[np.floating], shape: Array | None = None) -> Fit:
        """A neutral face (of ``shape``) placed on the landmarks."""
        neutral = Fit(
            scale=1.0,
            translation=np.zeros(2, np.float32),
            rotation=np.eye(3, dtype=np.float32),
            jaw=np.zeros(2, np.float32),
            gaze=np.zeros(2, np.float32),
            expression=np.zeros(EXPRESSION_SIZE, np.float32),
            shape=np.zeros(SHAPE_SIZE, np.float32) if shape is None else shape,
        )
        return rigid_start(self.basis, landmarks, neutral)

    def with_face_of(self, fit: Fit, coefficients: Coefficients) -> Fit:
        """``fit`` with the jaw, gaze and expression of known coefficients."""
        return replace(
            fit,
            jaw=coefficients.joint("jaw")[:2],
            gaze=coefficients.joint("left_eye")[:2],
            expression=coefficients.expression,
        )

    def solve(
        self,
        landmarks: NDArray[np.floating],
        start: Fit,
        *,
        fit_shape: bool,
        iterations: int,
    ) -> Fit:
        """Gauss-Newton from ``start``.

        Args:
            landmarks: (478, 3) image pixels; the third column is not used.
            start: where to begin; its shape is kept unless ``fit_shape``.
            fit_shape: also solve the identity (source images).
        """
        target = np.stack([landmarks[:, 0], -landmarks[:, 1]]).astype(np.float32)
        fit = start
        for _ in range(iterations):
            fit = self._step(target, fit, fit_shape)
        # Products of float32 rotations drift off the rotation group.
        u, _, vt = np.linalg.svd(fit.rotation.astype(np.float64))
        return replace(fit, rotation=(u @ vt).astype(np.float32))

    def _step(self, target: Array, fit: Fit, fit_shape: bool) -> Fit:
        basis = self.basis
        geometry = _geometry(basis, fit)
        turned = fit.rotation @ geometry.points
        count = turned.shape[1]
        scale = np.float32(fit.scale)
        residual = turned[:2] + (fit.translation[:, None] - target) / scale

        precision = basis.precision * np.float32(np.sqrt(EFFECTIVE_LANDMARKS / count))
        squared = (residual**2).sum(0) * precision**2
        weight = precision * (1 + squared / ROBUST_SCALE) ** np.float32(-0.25)

        size = SHAPE.stop if fit_shape else EXPRESSION.stop
        jacobian = np.zeros((2, count, size), np.float32)
        jacobian[:, :, 0] = turned[:2]
        jacobian[0, :, 1] = jacobian[1, :, 2] = 1
        jacobian[1, :, 3] = -turned[2]
        jacobian[0, :, 4] = turned[2]
        jacobian[0, :, 5], jacobian[1, :, 5] = -turned[1], turned[0]
        rows = fit.rotation[:2]
        jacobian[:, :, JAW.start : GAZE.stop] = np.einsum("ij,kjn->ink", rows, geometry.angles)
        jacobian[:, :, EXPRESSION] = _linear_columns(
            rows, geometry.jaw_turn, basis.expression, self.swung_expression
        )
        if fit_shape:
            jacobian[:, :, SHAPE] = _linear_columns(
                rows, geometry.jaw_turn, basis.shape, self.swung_shape
            )

        prior = np.zeros(size)
        prior[JAW] = JAW_OPENING_SIGMA**-2, JAW_SIDEWAYS_SIGMA**-2
        prior[GAZE] = GAZE_SIGMA**-2
        prior[EXPRESSION] = 1.0
        value = np.concatenate([np.zeros(RIGID), fit.jaw, fit.gaze, fit.expression])
        if fit_shape:
            prior[SHAPE] = 1.0
            value = np.concatenate([value, fit.shape])

        weighted = (jacobian * weight[:, None]).reshape(2 * count, size)
        hessian = (weighted.T @ weighted).astype(np.float64)
        hessian[np.diag_indices(size)] += prior + 1e-6
        gradient = weighted.T @ (residual * weight).ravel() + prior * value
        step = np.linalg.solve(hessian, -gradient).astype(np.float32)
        return _moved(fit, step, fit_shape)

    def projected(self, fit: Fit) -> Array:
        """Image points (478, 2) of the model's landmarks."""
        points = fit.rotation @ _geometry(self.basis, fit).points
        image = np.float32(fit.scale) * points[:2] + fit.translation[:, None]
        return np.stack([image[0], -image[1]], axis=1)

    def error(self, fit: Fit, landmarks: NDArray[np.floating]) -> float:
        """Mean distance of the model's landmarks from the given ones, in percent of the mean
        head's outer-eye distance at this scale (so it does not shrink when the head turns)."""
        distance = np.linalg.norm(self.projected(fit) - landmarks[:, :2], axis=1)
        return float(distance.mean() / (fit.scale * self.basis.eye_distance) * 100)

    def coefficients(self, fit: Fit) -> tuple[Coefficients, Camera]:
        """FLAME pose and camera: the same image, with the global rotation about the root joint."""
        basis = self.basis
        root = (
            basis.joints[0]
            + basis.joint_shape[0] @ fit.shape
            + basis.joint_expression[0] @ fit.expression
        )
        pose = np.zeros(15)
        pose[0:3] = cv2.Rodrigues(fit.rotation.astype(np.float64))[0][:, 0]
        pose[6:8] = fit.jaw
        pose[9:11] = pose[12:14] = fit.gaze
        shift = fit.translation / np.float32(fit.scale) - (root - fit.rotation @ root)[:2]
        return (
            Coefficients(fit.shape, fit.expression, pose.astype(np.float32)),
            Camera(float(fit.scale), float(shift[0]), float(shift[1])),
        )


def _moved(fit: Fit, step: Array, fit_shape: bool) -> Fit:
    turn, _ = cv2.Rodrigues(step[3:6].astype(np.float64))
    jaw = fit.jaw + step[JAW]
    return Fit(
        scale=fit.scale * float(np.exp(np.clip(step[0], -0.3, 0.3))),
        translation=fit.translation + step[1:3] * np.float32(fit.scale),
        rotation=turn.astype(np.float32) @ fit.rotation,
        jaw=np.array(
            [
                np.clip(jaw[0], *JAW_OPENING_LIMITS),
                np.clip(jaw[1], -JAW_SIDEWAYS_LIMIT, JAW_SIDEWAYS_LIMIT),
            ],
            np.float32,
        ),
        gaze=np.clip(fit.gaze + step[GAZE], -GAZE_LIMIT, GAZE_LIMIT),
        expression=fit.expression + step[EXPRESSION],
        shape=fit.shape + step[SHAPE] if fit_shape else fit.shape,
    )
