"""The colour of what the portrait hides: that of the nearest points it shows."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cvthead.deformation import to_pixels
from cvthead.head.model import Region
from cvthead.points import PointLayout
from cvthead.visibility import eroded, inside_mask

Array = NDArray[np.float32]

# Which parts of the head lend each other colours: a bald crown takes none from hair, nor hair any
# from an ear.
KINDS = (
    (Region.SCALP,),
    (Region.FACE, Region.EARS, Region.NECK),
    (Region.SHOULDERS,),
    (Region.EYES,),
    (Region.MOUTH,),
)
NEAREST = 8  # points that are averaged
CLOSE = 0.01  # normalised distance below which all weigh nearly the same
# Pixels of the 256 x 256 crop. Beside the outline hair is mixed with the background, and the points
# there are the nearest of a whole back of the head.
RIM = 4


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
    within = visible & inside_mask(points, eroded(source[3], RIM))
    everything = np.flatnonzero(within if within.any() else visible)
    if not len(everything):
        return out
    image = np.ascontiguousarray(source[:3].transpose(1, 2, 0))
    colours = sampled(image, to_pixels(points, len(image)))
    shell = np.arange(layout.surface, len(points))
    kinds = [np.flatnonzero(np.isin(layout.region, kind)) for kind in KINDS]
    for kind in (*kinds, shell):
        hidden, alike = kind[~known[kind]], kind[within[kind]]
        shown = alike if len(alike) >= NEAREST else everything
        if len(hidden):
            out[hidden] = _mean_colours(colours, points, hidden, shown)
    return out


def _mean_colours(
    colours: Array, points: Array, hidden: NDArray[np.intp], shown: NDArray[np.intp]
) -> Array:
    """(H, 3) around the hidden points, of those that are shown."""
    count = min(NEAREST, len(shown))
    distance, number = cKDTree(points[shown]).query(points[hidden], count)
    weight = 1 / (distance.reshape(-1, count) + CLOSE)
    weight /= weight.sum(1, keepdims=True)
    lent = colours[shown[number.reshape(-1, count)]]
    return np.asarray((lent * weight[..., None]).sum(1), np.float32)


def sampled(image: NDArray[Any], pixels: NDArray[np.floating]) -> Array:
    """(S, S, C) at pixel positions (N, 2+), bilinear, the border continued: (N, C) float32."""
    place = (pixels[:, None, :2] - 0.5).astype(np.float32)
    found = cv2.remap(image, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    return np.asarray(found, np.float32).reshape(len(pixels), -1)
