"""Places the 478 face-mesh landmarks on the final surface.

``data/landmark_embedding.npz`` holds, for every landmark, three MakeHuman vertices, barycentric
coordinates, the rms distance of the landmark network's points from that place, and the landmark
on the other side. The distances of the file in use were measured on rendered heads seen from many
sides; ``python -m tools.fit_landmarks`` makes such a file from portraits.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.closest import closest_points

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

EMBEDDING = Path(__file__).parent / "data" / "landmark_embedding.npz"
FIRST_IRIS = 468


@dataclass(frozen=True)
class Embedding:
    """Attributes: faces (478,), barycentric (478, 3), sigma (478,) in metres."""

    faces: Ints
    barycentric: Floats
    sigma: Floats


@dataclass(frozen=True)
class Ground:
    """The surface that landmarks may lie on.

    Attributes:
        vertices: (N, 3) mirror-symmetric template, metres.
        faces: (F, 3).
        mirror: (N,) the vertex across the plane x = 0.
        skin, eyes: (F,) faces that may carry face and iris landmarks.
    """

    vertices: Floats
    faces: Ints
    mirror: Ints
    skin: NDArray[np.bool_]
    eyes: NDArray[np.bool_]

    def nearest(self, points: Floats) -> tuple[Ints, Floats]:
        """Face (478,) and barycentric coordinates (478, 3) nearest each landmark's point."""
        face = np.empty(len(points), np.int64)
        barycentric = np.empty((len(points), 3))
        for chosen, allowed in (
            (slice(0, FIRST_IRIS), self.skin),
            (slice(FIRST_IRIS, None), self.eyes),
        ):
            index = np.nonzero(allowed)[0]
            nearest, barycentric[chosen] = closest_points(
                points[chosen], self.vertices, self.faces[index]
            )
            face[chosen] = index[nearest]
        return face, barycentric

    def place(self, points: Floats, pair: Ints, sigma: Floats) -> Embedding:
        """Nearest places of (478, 3) points, exactly mirror-consistent.

        Args:
            pair: (478,) the landmark on the other side.
            sigma: (478,) metres; each becomes the mean of both sides.
        """
        face, barycentric = self.nearest((points + points[pair] * [-1, 1, 1]) / 2)
        lookup = {frozenset(f): i for i, f in enumerate(self.faces.tolist())}
        for left, right in enumerate(pair.tolist()):
            if left >= right:
                continue
            twin = self.mirror[self.faces[face[left]]].tolist()
            face[right] = lookup[frozenset(twin)]
            place = dict(zip(twin, barycentric[left], strict=True))
            barycentric[right] = [place[v] for v in self.faces[face[right]].tolist()]
        return Embedding(face, barycentric, (sigma + sigma[pair]) / 2)

    def points(self, embedding: Embedding) -> Floats:
        """(478, 3) places on the template."""
        corners = self.vertices[self.faces[embedding.faces]]
        return np.asarray(np.einsum("lk,lkc->lc", embedding.barycentric, corners))


def embed_landmarks(
    base_template: Floats,
    ids: Ints,
    vertices: Floats,
    faces: Ints,
    mirror: Ints,
    skin: NDArray[np.bool_],
    eyes: NDArray[np.bool_],
) -> Embedding:
    """Nearest places on the skin, and for the irises on the eyeballs; mirror-consistent.

    Args:
        base_template: (B, 3) template at the MakeHuman vertices ``ids``.
        skin, eyes: (F,) faces that may carry face and iris landmarks.
    """
    with np.load(EMBEDDING, allow_pickle=False) as data:
        corners = np.searchsorted(ids, data["vertices"])
        points = np.einsum("lk,lkc->lc", data["barycentric"], base_template[corners])
        pair, sigma = data["mirror"], data["sigma"]
    return Ground(vertices, faces, mirror, skin, eyes).place(points, pair, sigma)
