"""Which points the source image sees.

A visible point may take colour and features from its projection (the pixel-aligned branch);
a hidden one must not, whatever lies in front of it (paper section 3.3, motivation).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.deformation import to_pixels
from cvthead.head.mesh import edges as mesh_edges
from cvthead.head.mesh import vertex_normals
from cvthead.points import PointLayout
from cvthead.silhouette import pixel_of

# Coarse enough that neighbouring vertices close the surface between them.
Z_BUFFER_PIXELS = 72
# Metres behind the nearest point that still count as the same surface.
DEPTH_TOLERANCE = 0.012
GRAZING = 0.1
MASK_LEVEL = 0.5
MARGIN = 1.0  # pixels
ROUNDS = 2
UNDECIDED = 0.1  # of the neighbours, more or less than half: the vertex's own answer stays


def visible_points(
    layout: PointLayout,
    points: NDArray[np.float32],
    mask: NDArray[np.float32],
    scale: float,
) -> NDArray[np.bool_]:
    """Points in front of the surface, facing the camera, inside frame and person mask.

    Args:
        layout: numbering of the points.
        points: (P, 3) normalised projections, those of the shell as many as there are.
        mask: (S, S) person mask of the crop, 0..1, 0 beyond the picture.
        scale: of the normalised camera, normalised units per metre.

    Returns:
        (P,) bool.
    """
    shown = inside_mask(points, mask)
    facing = towards_camera(layout, points) > -GRAZING
    found = _in_front(points, scale) & facing & shown
    return agreed(layout, found) & shown


def agreed(layout: PointLayout, visible: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Single vertices follow their neighbours on the mesh, and midpoints the ends of their edge.

    At the rim of what the portrait shows, the coarse z-buffer says now yes, now no; in a turned
    head that would be specks.

    Args:
        layout: numbering of the points.
        visible: (P,).

    Returns:
        (P,), shell points as they were.
    """
    out, count = visible.copy(), layout.vertices
    one, other = mesh_edges(layout.faces).T
    neighbours = np.bincount(one, minlength=count) + np.bincount(other, minlength=count)
    own = out[:count]
    for _ in range(ROUNDS):
        votes = np.bincount(one, own[other], count) + np.bincount(other, own[one], count)
        share = votes / np.maximum(neighbours, 1)
        own[:] = np.where(np.abs(share - 0.5) > UNDECIDED, share > 0.5, own)
    ends = own[layout.edges]
    middle = out[count : layout.surface]
    middle[:] = np.where(ends[:, 0] == ends[:, 1], ends[:, 0], middle)
    return out


def inside_mask(points: NDArray[np.float32], mask: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(P,) whether each projection lies in the frame and on the person."""
    inside, column, row = _pixels(points, mask.shape[0])
    return np.asarray(inside & (mask[row, column] > MASK_LEVEL))


def on_person(points: NDArray[np.float32], mask: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(P,) whether each projection lies on the person or at most MARGIN pixels beside.

    The others belong to parts of the body that the picture cuts off: nothing is known of them,
    so they are not drawn.
    """
    outside = (mask <= MASK_LEVEL).astype(np.uint8)
    distance = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_3)
    inside, column, row = _pixels(points, mask.shape[0])
    return np.asarray(inside & (distance[row, column] <= MARGIN))


def _pixels(
    points: NDArray[np.float32], size: int
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """As :func:`pixel_of`, for normalised projections."""
    return pixel_of(to_pixels(points, size), size)


def _in_front(points: NDArray[np.float32], scale: float) -> NDArray[np.bool_]:
    size = Z_BUFFER_PIXELS
    inside, column, row = _pixels(points, size)
    index = np.where(inside, row * size + column, size * size)
    nearest = np.full(size * size + 1, np.inf, dtype=np.float32)
    np.minimum.at(nearest, index, points[:, 2])
    return np.asarray(points[:, 2] <= nearest[index] + DEPTH_TOLERANCE * scale)


def towards_camera(layout: PointLayout, points: NDArray[np.float32]) -> NDArray[np.float32]:
    """(P,) cosine between each point's outward normal and the way to the camera, 1 for points of
    the shell, which have none; arguments as :func:`visible_points`."""
    vertices = points[: layout.vertices]
    # In image axes (y down, depth away) an outward normal towards the camera has negative z.
    towards = -vertex_normals(vertices, layout.faces)[:, 2]
    out = np.ones(len(points), np.float32)
    out[: layout.vertices] = towards
    out[layout.vertices : layout.surface] = towards[layout.edges].mean(1)
    return out


def eroded(mask: NDArray[np.float32], pixels: int) -> NDArray[np.float32]:
    """The mask without its outermost pixels, where background shines through."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1,) * 2)
    return np.asarray(cv2.erode(mask, kernel), np.float32)
