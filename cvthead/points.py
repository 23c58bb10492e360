"""The points that are splatted: mesh vertices, edge midpoints where detail is, shell points.

A face vertex every 5 mm is four pixels of a 256 x 256 frame, too coarse for eyes and lips. So
the midpoint of every edge of face, eyes and mouth is a point of its own: it costs no head-model
work, since it is the mean of two posed vertices, but gets its own descriptor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvthead.deformation import MAX_SHELL_POINTS
from cvthead.head import mesh
from cvthead.head.model import HeadModel, Region

DETAIL_REGIONS = (Region.FACE, Region.EYES, Region.MOUTH)
SEEN, SEEN_MIRRORED = 1.0, 0.5  # by the portrait; only the point across the face is; else 0
THROAT = 0.04  # metres behind the front teeth; what lies deeper is never seen
FAR_AWAY = np.array([-10.0, -10.0, 50.0], dtype=np.float32)


@dataclass(frozen=True, eq=False)
class PointLayout:
    """Numbering of the points: vertices, then midpoints, then shell points.

    Attributes:
        vertices: N, mesh vertices.
        faces: (T, 3) triangles over the mesh vertices.
        edges: (D, 2) end vertices of each midpoint.
        mirror: (N + D,) the mirrored counterpart of each point.
        region: (N + D,) Region of each point; a midpoint has its first vertex's.
        detail_vertices: (V,) vertices of face, eyes and mouth.
        detail_faces: (F, 3) triangles between those, numbered within detail_vertices.
        face: (Q,) points of the face, without eyes and mouth.
        inner: (total,) bool, points of eyes and mouth.
        throat: (T,) points of the mouth that lie too deep to be seen.
    """

    vertices: int
    faces: NDArray[np.int32]
    edges: NDArray[np.int32]
    mirror: NDArray[np.int32]
    region: NDArray[np.integer]
    detail_vertices: NDArray[np.int64]
    detail_faces: NDArray[np.int32]
    face: NDArray[np.intp]
    inner: NDArray[np.bool_]
    throat: NDArray[np.intp]

    @classmethod
    def of(cls, head: HeadModel) -> PointLayout:
        detail = np.isin(head.region, DETAIL_REGIONS)
        every = mesh.edges(head.faces)
        edges = every[detail[every].all(1)]
        flipped = np.sort(head.mirror[edges], axis=1)
        number = {tuple(edge): i for i, edge in enumerate(edges.tolist())}
        # The mesh's diagonals need not be mirrored; such an edge answers for itself.
        twin = [number.get(tuple(edge), i) for i, edge in enumerate(flipped.tolist())]
        count = len(head.template)
        mirror = np.concatenate([head.mirror, np.asarray(twin) + count])
        own, faces = np.unique(head.faces[detail[head.faces].all(1)], return_inverse=True)
        region = np.concatenate([head.region, head.region[edges[:, 0]]])
        forward = np.concatenate([head.template[:, 2], head.template[edges, 2].mean(1)])
        inner = np.isin(region, (Region.EYES, Region.MOUTH))
        mouth = region == Region.MOUTH
        deep = mouth & (forward < forward[mouth].max() - THROAT)
        return cls(
            count,
            head.faces,
            edges.astype(np.int32),
            mirror.astype(np.int32),
            region,
            own.astype(np.int64),
            faces.reshape(-1, 3).astype(np.int32),
            np.flatnonzero(region == Region.FACE),
            np.concatenate([inner, np.zeros(MAX_SHELL_POINTS, np.bool_)]),
            np.flatnonzero(deep),
        )

    @property
    def surface(self) -> int:
        """Points on the mesh: N + D."""
        return self.vertices + len(self.edges)

    @property
    def total(self) -> int:
        """All points, shell included: N + D + MAX_SHELL_POINTS."""
        return self.surface + MAX_SHELL_POINTS

    def arrange(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N + K, 3) projected vertices and shell points -> (total, 3), unused shell far away."""
        vertices = points[: self.vertices]
        shell = points[self.vertices :]
        out = np.empty((self.total, 3), dtype=np.float32)
        out[: self.vertices] = vertices
        middle = out[self.vertices : self.surface]
        one, other = (vertices.take(end, axis=0) for end in self.edges.T)
        np.add(one, other, out=middle)
        middle *= np.float32(0.5)
        out[self.surface : self.surface + len(shell)] = shell
        out[self.surface + len(shell) :] = FAR_AWAY
        return out
