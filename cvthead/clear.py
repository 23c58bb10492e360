"""Which visible points have a colour of their own in the portrait.

At the person's outline a pixel is mixed with the background; and where a cheek turns away from the
camera, an error of a pixel takes the colour of the collar or the wall behind it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.deformation import to_pixels
from cvthead.head.model import Region
from cvthead.points import PointLayout
from cvthead.visibility import eroded, inside_mask, towards_camera

Array = NDArray[np.float32]

# Pixels of the 256 x 256 crop beside the outline, where the person is mixed with the background.
RIM = 4
EDGE_ON = 0.3  # cosine between normal and camera up to which a foreign colour is not believed
SKIN = (Region.FACE, Region.EARS, Region.NECK)
FEWEST = 8  # points that tell what a part, skin or hair looks like
# Of the points of a kind, the share that is taken for typical, and how many standard deviations off
# them a colour may be.
TYPICAL = 0.75
RANGE = 3.0
NOISE = 0.04  # standard deviation that is added, of -1..1


def clear_points(
    layout: PointLayout, source: Array, points: Array, visible: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Visible points whose colour in the portrait is their own.

    Not those at the person's outline; nor those of face, ears and neck that are seen edge-on and
    look neither like the skin nor like the hair of this person.

    Args:
        layout: numbering of the points.
        source: (4, S, S) of cvthead.source.network_input.
        points: (P, 3) normalised projections.
        visible: (P,) of cvthead.visibility.visible_points.

    Returns:
        (P,) bool.
    """
    out, doubtful = doubtful_points(layout, source, points, visible)
    if doubtful.any():
        skin, hair = like_skin_and_hair(layout, own_colours(source, points), out)
        out |= doubtful & (skin | hair)
    return out


def doubtful_points(
    layout: PointLayout, source: Array, points: Array, visible: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Of the points that are not at the outline, those whose colour is surely their own, and those
    of face, ears and neck that are seen edge-on, (P,) each; arguments as :func:`clear_points`."""
    inside = visible & inside_mask(points, eroded(source[3], RIM))
    edge_on = towards_camera(layout, points) <= EDGE_ON
    edge_on[: layout.surface] &= np.isin(layout.region, SKIN)
    edge_on[layout.surface :] = False
    return inside & ~edge_on, inside & edge_on


def like_skin_and_hair(
    layout: PointLayout, colours: Array, sure: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(P,) whether each colour (P, 3) looks like this person's skin, and like their hair, told by
    the points whose colour is surely their own; all do if there are hardly any."""
    face, hair = np.zeros_like(sure), np.ones_like(sure)  # the shell is hair
    face[: layout.surface] = layout.region == Region.FACE
    hair[: layout.surface] = layout.region == Region.SCALP
    skin, hair = sure & face, sure & hair
    if min(skin.sum(), hair.sum()) < FEWEST:
        return np.ones_like(sure), np.ones_like(sure)
    return looks_like(colours, colours[skin]), looks_like(colours, colours[hair])


def looks_like(colours: Array, kind: Array) -> NDArray[np.bool_]:
    """(N,) whether colours (N, 3) look like those of a kind (K, 3), most of which are typical."""
    centre = np.median(kind, axis=0)
    off = np.square(kind - centre).sum(1)
    typical = kind[off <= np.quantile(off, TYPICAL)] - centre
    spread = typical.T @ typical / len(typical) + np.eye(3) * NOISE**2
    away = np.linalg.solve(spread, (colours - centre).T)
    return np.asarray(((colours - centre).T * away).sum(0) <= RANGE**2)


def own_colours(source: Array, points: Array) -> Array:
    """(P, 3) in -1..1 where each point (P, 3) lies in the picture (4, S, S)."""
    image = np.ascontiguousarray(source[:3].transpose(1, 2, 0))
    return sampled(image, to_pixels(points, len(image)))


def sampled(image: NDArray[Any], pixels: NDArray[np.floating]) -> Array:
    """(S, S, C) at pixel positions (N, 2+), bilinear, the border continued: (N, C) float32."""
    place = (pixels[:, None, :2] - 0.5).astype(np.float32)
    found = cv2.remap(image, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    return np.asarray(found, np.float32).reshape(len(pixels), -1)
