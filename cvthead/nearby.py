"""A first guess at the colour of what the portrait hides: that of the nearest points it shows."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cvthead.deformation import to_pixels
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
    image = np.ascontiguousarray(source[:3].transpose(1, 2, 0))
    colours = sampled(image, to_pixels(points[shown], len(image)))
    out[hidden] = (colours[number.reshape(-1, count)] * weight[..., None]).sum(1)
    return out


def sampled(image: NDArray[Any], pixels: NDArray[np.floating]) -> Array:
    """(S, S, C) at pixel positions (N, 2+), bilinear, the border continued: (N, C) float32."""
    place = (pixels[:, None, :2] - 0.5).astype(np.float32)
    found = cv2.remap(image, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    return np.asarray(found, np.float32).reshape(len(pixels), -1)
