"""Where landmarks lie on the head before any fit: the network's mean face, laid on the template."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from cvthead.tracking.landmark_basis import LEFT_EYE_OUTER, RIGHT_EYE_OUTER
from tools.landmarks import Floats, Ground, Ints

FOREHEAD, CHIN = 10, 152
RIGHT_IRIS, LEFT_IRIS = 468, 473
ROUNDS = 60
# Landmarks farther than this from the surface hardly count when the face is laid on it: metres.
ROBUST_DISTANCE = 0.005
# Pairs lie apart by no more than this on a mirrored mean face, in outer-eye distances.
MOST_ASYMMETRY = 0.05
_FLIP = np.array([-1.0, 1.0, 1.0])


def mean_face(landmarks: NDArray[np.floating]) -> Floats:
    """Mean of many faces in a frame of their own.

    Args:
        landmarks: (P, 478, 3) pixels, y down, depth growing away from the camera.

    Returns:
        (478, 3) x to the subject's left, y up, z out of the face; unit: outer-eye distance;
        origin between the outer eye corners.
    """
    points = landmarks * np.array([1.0, -1.0, -1.0])
    right, left = points[:, RIGHT_EYE_OUTER], points[:, LEFT_EYE_OUTER]
    width = np.linalg.norm(left - right, axis=1, keepdims=True)
    x = (left - right) / width
    y = points[:, FOREHEAD] - points[:, CHIN]
    y -= (y * x).sum(1, keepdims=True) * x
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    frames = np.stack([x, y, np.cross(x, y)], axis=1)
    centred = (points - (left + right)[:, None] / 2) / width[:, None]
    return np.asarray(np.einsum("pij,plj->pli", frames, centred).mean(0))


def mirror_pairs(face: Floats) -> Ints:
    """(478,) for every landmark of a mean face the one on the other side.

    Raises:
        ValueError: the face is too asymmetric to tell.
    """
    distance = cdist(face, face * _FLIP)
    _, pair = linear_sum_assignment(distance + distance.T)
    both_ways = np.array_equal(pair[pair], np.arange(len(face)))
    if not both_ways or distance[np.arange(len(face)), pair].max() > MOST_ASYMMETRY:
        raise ValueError("the mean face is not symmetric: more frontal portraits are needed")
    return np.asarray(pair, np.int64)


def laid_on(face: Floats, pair: Ints, ground: Ground) -> Floats:
    """The mean face (478, 3), moved, turned and scaled onto the template, metres.

    Iterated closest points (Besl and McKay, 1992) from the position in which the irises are at
    the front of the eyeballs.
    """
    source = (face + face[pair] * _FLIP) / 2
    eyes = ground.vertices[np.unique(ground.faces[ground.eyes])]
    eyes = eyes[eyes[:, 0] > 0]
    front = eyes[eyes[:, 2].argmax()]
    right, left = source[RIGHT_IRIS], source[LEFT_IRIS]
    points = (source - (right + left) / 2) * (2 * front[0] / (left[0] - right[0]))
    points += front * np.array([0.0, 1.0, 1.0])
    for _ in range(ROUNDS):
        faces, barycentric = ground.nearest(points)
        target = np.einsum("lk,lkc->lc", barycentric, ground.vertices[ground.faces[faces]])
        square: Floats = ((points - target) ** 2).sum(1)
        points = _similarity(points, target, 1 / (1 + square / ROBUST_DISTANCE**2))
    return np.asarray(points)


def _similarity(source: Floats, target: Floats, weight: Floats) -> Floats:
    """``source`` after the weighted similarity transform that brings it nearest to ``target``."""
    weight = weight / weight.sum()
    middle, goal = weight @ source, weight @ target
    a, b = source - middle, target - goal
    u, singular, vt = np.linalg.svd((b * weight[:, None]).T @ a)
    scale = singular.sum() / ((a**2).sum(1) @ weight)
    return np.asarray(scale * a @ (u @ vt).T + goal)
