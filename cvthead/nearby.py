"""A first guess at the colour of what the portrait hides: that of the nearest points it shows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cvthead.points import PointLayout

Array = NDArray[np.float32]

NEAREST = 8  # points that are averaged
CLOSE = 0.01  # normalised distance below which all weigh nearly the same


def nearby_colours(
    layout: PointLayout, source: Array, points: Array, visible: NDArray[np.bool_]
) -> Array:
    """Colours around the points that the portrait hides, weighted by inverse distance.

    Args:
        layout: numbering of the points.
        source: (4, S, S) of cvthead.source.network_input.
        points: (P, 3) normalised source projections; distances are taken in all three.
        visible: (P,) which of them the portrait sees.

    Returns:
        (P, 3) in -1..1; 0 for points that are visible, or whose mirrored counterpart is, since
        these have a colour, and for all if none is visible.
    """
    out = np.zeros((len(points), 3), np.float32)
    known = visible.copy()
    known[: layout.surface] |= visible[layout.mirror]
    hidden, shown = np.flatnonzero(~known), np.flatnonzero(visible)
    if not len(shown) or not len(hidden):
        return out
    count = min(NEAREST, len(shown))
    distance, number = cKDTree(points[shown]).query(points[hidden], count)
    weight = 1 / (distance.reshape(-1, count) + CLOSE)
    weight /= weight.sum(1, keepdims=True)
    colours = _sampled(source[:3], points[shown])[number.reshape(-1, count)]
    out[hidden] = (colours * weight[..., None]).sum(1)
    return out


def _sampled(image: Array, points: Array) -> Array:
    """(3, S, S) at normalised points (P, 2+) -> (P, 3), bilinear, the border continued."""
    size = image.shape[-1]
    x, y = ((points[:, :2] * 0.5 + 0.5) * size - 0.5).T.astype(np.float32)[..., None]
    pixels = np.ascontiguousarray(image.transpose(1, 2, 0))
    found = cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float32).reshape(-1, 3)
