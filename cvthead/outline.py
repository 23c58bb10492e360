"""Least squares that bring the outline of the projected mesh to the outline of the person.

Lengths are in pixels of the 256 x 256 crop, which spans 0.36 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from cvthead.head.mesh import edges
from cvthead.head.model import HeadModel, Region
from cvthead.silhouette import Mask, Points, pixel_of, rasterise, signed_distance

Vectors = NDArray[np.float64]

ROUNDS = 5
STEP = 0.8
OUTLINE_WIDTH = 2.2
OUTWARD_REACH = 70
INWARD_REACH = 18
UNKNOWN_REACH = 42  # towards the border of the picture, where it cuts the person off

# Weights of the least squares, relative to a vertex of the outline.
SMOOTHNESS = 0.35
INSIDE_PULL = 0.3
UNKNOWN_PULL = 0.3
STIFFNESS = 1e-3
EAR_STIFFNESS = 10.0


@dataclass(frozen=True, eq=False)
class OutlineModel:
    """The part of the fit that depends on the head alone.

    Attributes:
        fixed_faces: (P, 3) triangles of which no vertex may move.
        moving_faces: (F - P, 3) the others.
        free: (M,) vertices that may move: scalp, neck, shoulders, ears.
        pulled: (N,) bool, those the outline may pull directly: not the ears.
        laplacian: (M, M) weighted graph Laplacian; edges to pinned vertices count on the
            diagonal, so that the displacement fades to zero towards the face.
        stiffness: (M,) pull of each vertex towards its place.
    """

    fixed_faces: NDArray[np.int32]
    moving_faces: NDArray[np.int32]
    free: NDArray[np.intp]
    pulled: Mask
    laplacian: sparse.csc_array
    stiffness: Vectors

    @classmethod
    def from_head(cls, head: HeadModel) -> OutlineModel:
        """Inverse edge lengths as weights; face, eyes and mouth are left out, hence pinned."""
        pulled = np.isin(head.region, [Region.SHOULDERS, Region.NECK, Region.SCALP])
        ears = head.region == Region.EARS
        free = np.flatnonzero(pulled | ears)
        faces = head.faces
        pairs = edges(faces)
        length = np.linalg.norm(head.template[pairs[:, 0]] - head.template[pairs[:, 1]], axis=1)
        weight = 1 / np.maximum(length.astype(np.float64), 2e-3)
        weight /= weight.mean()
        count = len(head.template)
        graph = sparse.coo_array((weight, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        graph = (graph + graph.T).tocsr()
        laplacian = (sparse.diags_array(graph.sum(axis=1)) - graph).tocsr()
        moving = (pulled | ears)[faces].any(axis=1)
        return cls(
            fixed_faces=faces[~moving],
            moving_faces=faces[moving],
            free=free,
            pulled=pulled,
            laplacian=sparse.csc_array(laplacian[free][:, free]),
            stiffness=np.where(ears[free], EAR_STIFFNESS, STIFFNESS),
        )

    def fit(self, flat: Points, mask: Mask, valid: Mask) -> Vectors:
        """Displacement (N, 2) in pixels of the projected vertices (N, 2).

        Each round draws the mesh, pulls the vertices on its outline along the outline's normal
        to the edge of the mask, and smooths.
        """
        size = mask.shape[0]
        person = signed_distance(mask)
        slope = gradient(person)
        fixed = rasterise(flat, self.fixed_faces, size)
        moved = np.zeros(flat.shape)
        for _ in range(ROUNDS):
            place = flat + moved
            drawn = fixed | rasterise(place, self.moving_faces, size)
            # Smoothed, so that single triangles do not turn the normals.
            mesh = np.asarray(cv2.GaussianBlur(signed_distance(drawn), (0, 0), 2.5))
            within, column, row = pixel_of(place, size)
            known = within & self.pulled & valid[row, column]
            weight = np.zeros(len(flat))
            pull = np.zeros(flat.shape)

            # Vertices on the background go to the nearest part of the person.
            gap = -person[row, column]
            away = known & (gap > 0) & (gap < INWARD_REACH)
            pull[away] = unit(slope[row[away], column[away]]) * (gap[away, None] + 1)
            weight[away] = INSIDE_PULL

            outline = np.flatnonzero(known & (np.abs(mesh[row, column]) < OUTLINE_WIDTH))
            normal = -unit(gradient(mesh)[row[outline], column[outline]])
            step, strength = outline_pull(place[outline], normal, person, valid)
            found = strength > 0
            pull[outline[found]] = STEP * step[found]
            weight[outline[found]] = strength[found]

            goal = moved + pull
            moved[self.free] = self.smoothed(goal[self.free], weight[self.free])
        return moved

    def smoothed(self, goal: Vectors, weight: Vectors) -> Vectors:
        """The smooth field (M, 2) nearest to the goals (M, 2) under the weights (M,)."""
        system = SMOOTHNESS * self.laplacian + sparse.diags_array(weight + self.stiffness)
        # Symmetric positive definite: no pivoting, and an ordering made for symmetry.
        factor = splu(
            sparse.csc_array(system),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        return np.asarray(factor.solve(goal * weight[:, None]))


def outline_pull(
    place: Vectors, normal: Vectors, person: NDArray[np.float32], valid: Mask
) -> tuple[Vectors, Vectors]:
    """How far each point of the outline (P, 2) is from the person's edge along its normal.

    Args:
        place: (P, 2) pixels.
        normal: (P, 2) unit vectors out of the mesh.
        person: (S, S) signed distance to the person's edge.
        valid: (S, S), False where nothing is known.

    Returns:
        Displacement (P, 2) to the edge and its weight (P,), 0 if no edge was met within reach.
    """
    size = person.shape[0]
    _, column, row = pixel_of(place, size)
    within = person[row, column] > 0
    sign = np.where(within, 1, -1)
    reach = np.arange(1, OUTWARD_REACH + 1)
    ray = place[:, None] + (sign[:, None] * normal)[:, None] * reach[None, :, None]
    in_picture, column, row = pixel_of(ray.reshape(-1, 2), size)
    known = (in_picture & valid[row, column]).reshape(ray.shape[:2])
    on_person = (person[row, column] > 0).reshape(ray.shape[:2])
    hit = known & (on_person != within[:, None])
    # Nothing beyond the picture's border counts.
    open_end = np.where(known.all(axis=1), OUTWARD_REACH, known.argmin(axis=1))
    first = np.where(hit.any(axis=1), hit.argmax(axis=1), OUTWARD_REACH)
    found = (first < open_end) & (within | (first < INWARD_REACH))
    # The person goes on beyond the border: move towards it, with less weight.
    cut = within & ~found & (open_end < OUTWARD_REACH)
    distance = np.where(cut, np.clip(open_end - 1, 0, UNKNOWN_REACH), first + 1)
    weight = np.where(found, 1.0, np.where(cut, UNKNOWN_PULL, 0.0))
    return normal * (sign * distance)[:, None], weight


def gradient(image: NDArray[Any]) -> Vectors:
    """(S, S) -> (S, S, 2): change per pixel to the right and downwards."""
    down, right = np.gradient(image.astype(np.float64))
    return np.stack([right, down], axis=-1)


def unit(vectors: NDArray[np.floating]) -> Vectors:
    return np.asarray(vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-6))
