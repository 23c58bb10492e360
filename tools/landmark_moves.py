"""Moves landmarks on the head's surface to where portraits show them.

Every portrait's landmarks are solved with the embedding as it is; what remains between a found
landmark and its place, looked at over all portraits, tells where on the surface the place should
be. Both steps use the solved heads as they are, so they are alternated with new solutions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cvthead.head.model import HeadModel
from cvthead.tracking.landmark_basis import landmark_basis
from cvthead.tracking.solver import Fit, Solver
from tools.landmarks import FIRST_IRIS, Embedding, Floats, Ground, Ints

FIRST_ITERATIONS, NEXT_ITERATIONS = 10, 3
# How far a landmark may jump at once, metres: from one lip to the other, not across the face.
REACH = 0.008
# Places tried on every triangle: all barycentric coordinates of this denominator. The triangles
# of the face have sides of 5 mm.
DIVISIONS = 4
# A landmark counts by how much its place faces the camera, and never less than this.
LEAST_FACING = 0.05
# Share of a move's square length that is added to the residuals, so that a place seen edge-on
# does not run away.
DAMPING = 0.1


@dataclass(frozen=True, eq=False)
class Solved:
    """Portraits solved with one embedding.

    Attributes:
        fits: one per portrait.
        error: median over the portraits of the tracker's error, percent.
        targets: (P, 478, 2) found landmarks in metres in the plane of the picture, y up.
        heads: (P, N, 3) posed heads at the same place, metres.
        weights: (P, 478) how much each landmark counts.
    """

    fits: tuple[Fit, ...]
    error: float
    targets: Floats
    heads: NDArray[np.float32]
    weights: Floats


def with_embedding(head: HeadModel, embedding: Embedding) -> HeadModel:
    return replace(
        head,
        landmark_faces=embedding.faces.astype(np.int32),
        landmark_bary=embedding.barycentric.astype(np.float32),
        landmark_sigma=embedding.sigma.astype(np.float32),
    )


def solve_portraits(
    head: HeadModel,
    embedding: Embedding,
    landmarks: NDArray[np.floating],
    starts: Sequence[Fit] | None,
) -> Solved:
    """Solve identity, expression and pose of (P, 478, 3) landmarks in pixels.

    Args:
        starts: the solution with an earlier embedding; None starts anew.
    """
    carrying = with_embedding(head, embedding)
    solver = Solver.for_basis(landmark_basis(carrying))
    iterations = FIRST_ITERATIONS if starts is None else NEXT_ITERATIONS
    begin = [solver.start(portrait) for portrait in landmarks] if starts is None else starts
    fits = tuple(
        solver.solve(portrait, start, fit_shape=True, iterations=iterations)
        for portrait, start in zip(landmarks, begin, strict=True)
    )
    heads = np.empty((len(fits), *head.template.shape), np.float32)
    targets = np.empty((*landmarks.shape[:2], 2))
    for i, (fit, portrait) in enumerate(zip(fits, landmarks, strict=True)):
        coefficients, camera = solver.coefficients(fit)
        heads[i] = carrying.vertices(coefficients)
        targets[i] = portrait[:, :2] * [1, -1] / camera.scale - [camera.tx, camera.ty]
    edges = _edges(heads[:, head.faces[embedding.faces]])
    normals = np.cross(edges[:, :, 0], edges[:, :, 1])
    facing = normals[..., 2] / np.maximum(np.linalg.norm(normals, axis=-1), 1e-12)
    errors = [solver.error(fit, portrait) for fit, portrait in zip(fits, landmarks, strict=True)]
    return Solved(
        fits, float(np.median(errors)), targets, heads, facing.clip(LEAST_FACING, 1).astype(float)
    )


def searched(ground: Ground, embedding: Embedding, pair: Ints, solved: Solved) -> Floats:
    """(478, 3) of all places within REACH those with the least squared distance from the found
    landmarks, summed over the portraits.

    Only this finds the other lip: on the template the two lips touch, but the lower one moves
    with the jaw.
    """
    here = ground.points(embedding)
    moved = here.copy()
    for chosen, allowed in (
        (np.arange(FIRST_IRIS), ground.skin),
        (np.arange(FIRST_IRIS, len(pair)), ground.eyes),
    ):
        face, barycentric = _grid(ground, allowed, here[chosen])
        corners = ground.faces[face]
        places = np.einsum("ck,ckd->cd", barycentric, ground.vertices[corners])
        sums = _squares(solved, solved.heads, corners, barycentric, chosen)
        sums += _squares(solved, solved.heads[:, ground.mirror], corners, barycentric, pair[chosen])
        distance = np.linalg.norm(places[:, None] - here[chosen], axis=2)
        best = np.where(distance <= REACH, sums, np.inf).argmin(0)
        moved[chosen] = places[best]
    return moved


def slid(ground: Ground, embedding: Embedding, solved: Solved) -> Floats:
    """(478, 3) places moved along their triangles' planes by least squares over the portraits."""
    corners = ground.faces[embedding.faces]
    residual = _residual(ground, embedding, solved)
    edges = _edges(solved.heads[:, corners])[..., :2].astype(float)  # (P, 478, 2 edges, 2)
    weighted = solved.weights[..., None, None] * edges
    flat = _edges(ground.vertices[corners])
    normal = np.einsum("plac,plbc->lab", weighted, edges)
    normal += DAMPING * len(residual) * np.einsum("lac,lbc->lab", flat, flat)
    right = np.einsum("plac,plc->la", weighted, residual)
    share = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(ground.points(embedding) + np.einsum("la,lac->lc", share, flat))


def remaining(ground: Ground, embedding: Embedding, solved: Solved) -> Floats:
    """(478,) weighted rms distance of the found landmarks from their places, metres."""
    square = (_residual(ground, embedding, solved) ** 2).sum(2)
    return np.asarray(
        np.sqrt((solved.weights * square).sum(0) / solved.weights.sum(0)), dtype=np.float64
    )


def _squares(
    solved: Solved,
    heads: NDArray[np.float32],
    corners: Ints,
    barycentric: Floats,
    landmarks: Ints,
) -> Floats:
    """(C, L) weighted squared distances of C places from L landmarks, summed over the portraits;
    less what does not depend on the place."""
    seen = np.einsum("ck,pckd->cpd", barycentric, heads[:, corners, :2])
    weight = solved.weights[:, landmarks]
    goals = weight[..., None] * solved.targets[:, landmarks]
    crossed = np.tensordot(seen, goals.transpose(0, 2, 1), axes=2)
    return np.asarray((seen**2).sum(2) @ weight - 2 * crossed)


def _residual(ground: Ground, embedding: Embedding, solved: Solved) -> Floats:
    corners = solved.heads[:, ground.faces[embedding.faces], :2]
    return np.asarray(solved.targets - np.einsum("lk,plkc->plc", embedding.barycentric, corners))


def _edges(corners: NDArray[np.floating]) -> NDArray[np.floating]:
    """(..., 3, C) corners -> (..., 2, C) edges from the first corner."""
    return np.asarray(corners[..., 1:, :] - corners[..., :1, :])


def _grid(ground: Ground, allowed: NDArray[np.bool_], near: Floats) -> tuple[Ints, Floats]:
    """Face (C,) and barycentric coordinates (C, 3) of the places to try around ``near``."""
    middles = ground.vertices[ground.faces].mean(1)
    distance = np.linalg.norm(middles[:, None] - near, axis=2).min(1)
    face = np.nonzero(allowed & (distance <= REACH))[0]
    steps = range(DIVISIONS + 1)
    grid = np.array(
        [(a, b, DIVISIONS - a - b) for a in steps for b in steps if a + b <= DIVISIONS], float
    )
    return np.repeat(face, len(grid)), np.tile(grid / DIVISIONS, (len(face), 1))
