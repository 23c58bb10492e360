"""The colour of what the portrait hides: that of the nearest points it shows, and where it shows
the other side of the head, that side's in this one's light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cvthead.clear import FEWEST, SKIN, looks_like, own_colours
from cvthead.head.model import Region
from cvthead.points import PointLayout

Array = NDArray[np.float32]

# Which parts of the head lend each other colours: a bald crown takes none from hair, nor hair any
# from an ear.
KINDS = (
    (Region.SCALP,),
    SKIN,
    (Region.SHOULDERS,),
    (Region.EYES,),
    (Region.MOUTH,),
)
NEAREST = 16  # points that are averaged
CLOSE = 0.01  # normalised distance below which all weigh nearly the same
COVERED = 0.25  # a part of which less than this share looks like skin is covered: scarves, veils
LIGHT = 0.4  # highest difference between the sides, of -1..1; beyond it is no light, but a shadow
COVER_REACH = 0.1  # normalised distance, about 2 cm: so far on do hair and collars go on unseen


def hidden_colours(
    layout: PointLayout, source: Array, points: Array, clear: NDArray[np.bool_]
) -> Array:
    """Colours of the points that the portrait hides, or shows only mixed with the background.

    They are the mean of the nearest points of the same kind, weighted by inverse squared distance.
    Hair and clothes that lie on face, ears or neck go on for about COVER_REACH, then there is skin.
    If the mirrored point is clear, half of it is that point's colour, plus how the near points
    differ from theirs: by the light.

    Args:
        layout: numbering of the points.
        source: (4, S, S) of cvthead.source.network_input.
        points: (P, 3) normalised source projections; distances are taken in all three.
        clear: (P,) of cvthead.clear.clear_points.

    Returns:
        (P, 3) in -1..1; 0 for points that are clear, and for all if none is.
    """
    out = np.zeros((len(points), 3), np.float32)
    everything = np.flatnonzero(clear)
    if not len(everything):
        return out
    colours = own_colours(source, points)
    bare = _bare(layout, colours, clear)
    shell = np.arange(layout.surface, len(points))
    kinds = [np.flatnonzero(np.isin(layout.region, kind)) for kind in KINDS]
    for kind in (*kinds, shell):
        hidden, alike = kind[~clear[kind]], kind[clear[kind]]
        if not len(hidden):
            continue
        shown = alike if len(alike) >= FEWEST else everything
        out[hidden], lenders, distance = _mean(colours, points, hidden, shown)
        skin, beside = alike[bare[alike]], ~bare[lenders].all(1)
        if len(skin) >= FEWEST and beside.any():
            under = hidden[beside]
            far = 1 - np.exp(-np.square(distance[beside, None] / COVER_REACH))
            out[under] += far * (_mean(colours, points, under, skin)[0] - out[under])
    other = clear[layout.mirror] & (layout.mirror != np.arange(layout.surface))
    both = clear[: layout.surface] & other & bare[: layout.surface] & bare[layout.mirror]
    for kind in kinds:
        across = kind[~clear[kind] & other[kind]]
        if len(across):
            seen = _from_across(layout, colours, points, across, kind[both[kind]])
            out[across] = (out[across] + seen) / 2
    return out


def _from_across(
    layout: PointLayout,
    colours: Array,
    points: Array,
    hidden: NDArray[np.intp],
    both: NDArray[np.intp],
) -> Array:
    """(H, 3) of the points across the face, in the light that falls on this side: it is told by
    the points of which the portrait sees both."""
    other = colours[layout.mirror[hidden]]
    if len(both) < FEWEST:
        return other
    surface = colours[: layout.surface]
    light = _mean(surface - surface[layout.mirror], points, hidden, both)[0]
    light = light.clip(-LIGHT, LIGHT)
    return np.asarray(np.clip(other + light, -1, 1))


def _bare(layout: PointLayout, colours: Array, clear: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(P,) False for those of face, ears and neck that hair or clothes cover, by their colour.

    A part of which hardly anything looks like skin is left as it is.
    """
    count = layout.surface
    own, colours, region = clear[:count], colours[:count], layout.region
    out = np.ones(len(clear), np.bool_)
    face = colours[own & (region == Region.FACE)]
    if len(face) < FEWEST:
        return out
    skin = looks_like(colours, face)
    for name in SKIN:
        part = own & (region == name)
        if skin[part].sum() >= COVERED * part.sum():
            out[:count][part] = skin[part]
    return out


def _mean(
    values: Array, points: Array, hidden: NDArray[np.intp], shown: NDArray[np.intp]
) -> tuple[Array, NDArray[np.intp], Array]:
    """Values (P, 3) around the hidden points, of those that are shown: (H, 3); (H, k) which ones
    lend, and (H,) how far the nearest is."""
    count = min(NEAREST, len(shown))
    # Each tree is asked once: a balanced one takes longer to build than it saves.
    tree = cKDTree(points[shown], compact_nodes=False, balanced_tree=False)
    distance, number = tree.query(points[hidden], count)
    distance, lenders = distance.reshape(-1, count), shown[number.reshape(-1, count)]
    weight = (distance + CLOSE) ** -2
    weight /= weight.sum(1, keepdims=True)
    mean = np.einsum("hk,hkc->hc", weight, values[lenders])
    return mean.astype(np.float32), lenders, distance[:, 0]
