"""ARKit's blendshapes for the user's FLAME, fitted to FLAME's own landmarks.

The open head knows what each of the 52 units does. Its motion at the 51 inner landmarks (brows,
nose, eyes, lips) is scaled to FLAME's size, what FLAME's jaw already does is taken off, and the
expression coefficients that come nearest to the rest are found by ridge regression. Jaw and eye
rotations are the open head's. Units that move no landmark (tongue, cheeks) keep only those.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cvthead.coefficients import EXPRESSION_SIZE, Coefficients
from cvthead.head.arkit import ARKIT_NAMES, ArkitMap
from cvthead.head.model import HeadModel
from cvthead.official.flame import Flame
from cvthead.tracking.landmarks68 import landmarks68

Array = NDArray[np.float32]

CONTOUR = 17  # landmarks of the jaw line, which slide over the surface
RIGHT_EYE_OUTER, LEFT_EYE_OUTER = 36 - CONTOUR, 45 - CONTOUR
# Metres of landmark error that weigh as much as one standard deviation of a coefficient.
TOLERANCE = 0.0005


def fit_arkit(flame: Flame, open_head: HeadModel, open_map: ArkitMap) -> ArkitMap:
    """The linear map from ARKIT_NAMES to FLAME's coefficients."""
    head = flame.head()
    neutral = Coefficients.zeros()
    flame_rest = _inner(flame, head, neutral)
    open_rest = _open_inner(open_head, neutral)
    size = _eye_distance(flame_rest) / _eye_distance(open_rest)
    corners = head.expression_basis[flame.faces[flame.landmark_faces[CONTOUR:]]]
    basis = np.einsum("lk,lkce->lce", flame.landmark_bary[CONTOUR:], corners)
    basis = basis.reshape(-1, EXPRESSION_SIZE)
    wanted = []
    for number, name in enumerate(ARKIT_NAMES):
        motion = _open_inner(open_head, open_map.to_coefficients({name: 1.0})) - open_rest
        posed = Coefficients(neutral.shape, neutral.expression, open_map.pose[:, number])
        by_joints = _inner(flame, head, posed) - flame_rest
        wanted.append((motion * size - by_joints).ravel())
    targets = np.stack(wanted, axis=1)
    normal = basis.T @ basis + TOLERANCE**2 * np.eye(EXPRESSION_SIZE)
    expression = np.linalg.solve(normal, basis.T @ targets)
    scale = np.sqrt((basis**2).reshape(-1, 3, EXPRESSION_SIZE).sum(1).mean(0))
    return ArkitMap(expression.astype(np.float32), open_map.pose.copy(), scale.astype(np.float32))


def _inner(flame: Flame, head: HeadModel, coefficients: Coefficients) -> Array:
    return flame.landmarks(head.vertices(coefficients))[CONTOUR:]


def _open_inner(head: HeadModel, coefficients: Coefficients) -> Array:
    landmarks = landmarks68(head.landmarks(head.vertices(coefficients)))
    return np.asarray(landmarks[CONTOUR:], dtype=np.float32)


def _eye_distance(inner: Array) -> float:
    return float(np.linalg.norm(inner[LEFT_EYE_OUTER] - inner[RIGHT_EYE_OUTER]))
