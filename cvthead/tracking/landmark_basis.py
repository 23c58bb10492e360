"""The linear part of a head model at its face landmarks, all the solver needs to know.

The solver never sees a mesh: ``landmark_basis`` reduces any HeadModel (the packaged one or an
imported FLAME) to the template, bases and skinning weights blended at the landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvthead.errors import AssetError
from cvthead.head.model import HeadModel

Array = NDArray[np.float32]

# Outer eye corners of the 478-point topology (subject's right, left).
RIGHT_EYE_OUTER, LEFT_EYE_OUTER = 33, 263
# Error of the landmark network itself, in metres on the face, measured on real photographs
# with the embedding error (``HeadModel.landmark_sigma``) taken off.
NETWORK_SIGMA = 0.0022
# The network's eye and lip contours come from its refined branches (Grishchenko et al., 2020) and
# carry the expression, but are few against cheeks and forehead: without more weight a blink stays
# a third open. Twice the weight closes it and leaves the overall error unchanged.
CONTOUR_WEIGHT = 2.0
# fmt: off
CONTOURS = (
    33, 7, 163, 144, 145, 153, 154, 155, 133, 246, 161, 160, 159, 158, 157, 173,
    263, 249, 390, 373, 374, 380, 381, 382, 362, 466, 388, 387, 386, 385, 384, 398,
    61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185,
    78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191,
)
# fmt: on
# Joints that move landmarks relative to the head: jaw, left eye, right eye.
MOVING_JOINTS = (2, 3, 4)


@dataclass(frozen=True, eq=False)
class LandmarkBasis:
    """A head model at its N landmarks. Axis first: (3, N, ...), metres.

    Attributes:
        template: (3, N) mean head.
        shape: (3, N, 100), expression: (3, N, 50) linear bases.
        pose: (3, N, 27) correctives for the row-major ``R - I`` of jaw, left and right eye
            (the neck is never bent by the tracker).
        weights: (3, N) skinning weights of jaw, left eye, right eye.
        joints: (5, 3) rest joints of the mean head; joint_shape: (5, 3, 100) and
            joint_expression: (5, 3, 50) how they move with the coefficients.
        precision: (N,) weight of a landmark's residual: 1 / standard deviation, 1/metres.
        eye_distance: outer-eye distance of the mean head, metres: the unit of reported errors.
    """

    template: Array
    shape: Array
    expression: Array
    pose: Array
    weights: Array
    joints: Array
    joint_shape: Array
    joint_expression: Array
    precision: Array
    eye_distance: float


def landmark_basis(head: HeadModel) -> LandmarkBasis:
    """Blend the head model's arrays at its embedded landmarks (face index + barycentric).

    Raises:
        AssetError: the head model has no landmarks.
    """
    if len(head.landmark_faces) == 0:
        raise AssetError(
            "the head model has no face landmarks, so it cannot be tracked",
            hint="Embed the 478 landmarks in the converted model first.",
        )
    corners = head.faces[head.landmark_faces]
    barycentric = head.landmark_bary

    def blended(values: NDArray[np.floating]) -> Array:
        weighted = np.einsum("nk,nk...->n...", barycentric, values[corners])
        return np.asarray(weighted, np.float32)

    def axis_first(values: Array) -> Array:
        return np.ascontiguousarray(np.moveaxis(values, 1, 0))

    vertices = len(head.template)
    pose = blended(head.pose_basis.reshape(36, vertices, 3).transpose(1, 2, 0))
    template = blended(head.template)
    regressor = head.joint_regressor
    precision = 1 / np.hypot(NETWORK_SIGMA, head.landmark_sigma)
    precision[list(CONTOURS)] *= CONTOUR_WEIGHT
    return LandmarkBasis(
        template=axis_first(template),
        shape=axis_first(blended(head.shape_basis)),
        expression=axis_first(blended(head.expression_basis)),
        pose=axis_first(pose[:, :, 9:]),
        weights=axis_first(blended(head.weights)[:, MOVING_JOINTS]),
        joints=(regressor @ head.template).astype(np.float32),
        joint_shape=np.einsum("jv,vck->jck", regressor, head.shape_basis).astype(np.float32),
        joint_expression=np.einsum("jv,vck->jck", regressor, head.expression_basis).astype(
            np.float32
        ),
        precision=precision.astype(np.float32),
        eye_distance=float(np.linalg.norm(template[RIGHT_EYE_OUTER] - template[LEFT_EYE_OUTER])),
    )
