"""What needs several people: cross-identity reenactment, and identity on the common scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cvthead.evaluation.clip import LENT, Bench, Clip
from cvthead.evaluation.cross_identity import (
    YAWS,
    Found,
    cross,
    cross_table,
    pairs,
    turn,
    turned_table,
)
from cvthead.evaluation.identity import Embed, Scale
from cvthead.evaluation.methods import Drawn
from cvthead.evaluation.page import Grid, Rows
from cvthead.evaluation.paper_metrics import UserNetworks, paper_table
from cvthead.evaluation.reenactment import picture
from cvthead.evaluation.retracking import retrack
from cvthead.evaluation.shots import Image, Shot
from cvthead.evaluation.table import Table
from cvthead.tracking.tracker import Tracker

CROSS, TURNED = "Cross-identity", "Turned"


@dataclass(frozen=True, eq=False)
class Crossing:
    """One source driven by one other person.

    Attributes:
        found: in each method's result; None where no face is.
        made: the results on white.
        cosines: raw, of the user's embedder, by method; without results that show no face.
    """

    source: Shot
    driver: Shot
    found: Mapping[str, Found | None]
    made: Mapping[str, Image]
    cosines: Mapping[str, float]


def crossings(bench: Bench, clips: Sequence[Clip], each: int, csim: Embed | None) -> list[Crossing]:
    """Drive every clip's source by ``each`` frames of other people's clips.

    Args:
        csim: the user's embedder, for the paper's table.
    """
    lent = [shot for clip in clips for shot in clip.lent]
    done = []
    crossed = pairs([clip.identity for clip in clips], LENT, each)
    for number, other in tqdm(crossed, desc="other drivers", unit="pair"):
        clip, driver = clips[number], lent[other]
        found, drawn = cross(
            bench.tracker, bench.embed, clip.source, clip.known, clip.persons, driver
        )
        made = {name: one.on_white for name, one in drawn.items()}
        cosines = user_cosines(bench.tracker, csim, clip.source, drawn) if csim else {}
        done.append(Crossing(clip.source, driver, found, made, cosines))
    return done


def user_cosines(
    tracker: Tracker, embed: Embed, source: Shot, drawn: Mapping[str, Drawn]
) -> dict[str, float]:
    """Raw cosines between the source and each result in which a face is found."""
    known = embed(source.image, source.face)
    faces = {
        name: retrack(tracker, one, source.face.coefficients.shape) for name, one in drawn.items()
    }
    return {
        name: float(embed(drawn[name].on_white, face) @ known)
        for name, face in faces.items()
        if face is not None
    }


def scale_of(clips: Sequence[Clip]) -> Scale | None:
    """CSIM's 0 and 1; None without an embedder or with a single person."""
    # One embedding each: two clips of one person would count that person as different people.
    known = {clip.identity: clip.known for clip in reversed(clips) if clip.known is not None}
    same = [cosine for clip in clips for cosine in clip.same]
    return Scale.of(same, list(known.values())) if len(known) > 1 else None


def cross_tables(
    bench: Bench,
    clips: Sequence[Clip],
    each: int,
    networks: UserNetworks,
    speeds: Mapping[str, NDArray[np.float64]],
) -> tuple[dict[str, list[Table]], dict[str, list[Grid]]]:
    """Tables of cross-identity and of turned heads, and their pictures, by heading.

    Args:
        each: drivers per source.
        speeds: for the paper's table, see cvthead.evaluation.speed.
    """
    scale = scale_of(clips)
    turned, turned_grids = turns(bench, clips)
    sections: dict[str, list[Table]] = {CROSS: [], TURNED: [turned_table(turned, scale)]}
    done = crossings(bench, clips, each, networks.csim)
    if not done:  # a single person
        return sections, {TURNED: turned_grids}
    names = list(done[0].made)
    sections[CROSS] = [
        cross_table([one.found for one in done], scale),
        paper_table(
            networks,
            [picture(clip.source) for clip in clips],
            {name: [one.made[name] for one in done] for name in names},
            {name: [o.cosines[name] for o in done if name in o.cosines] for name in names},
            speeds,
        ),
    ]
    return sections, {CROSS: crossing_grids(done), TURNED: turned_grids}


def turns(bench: Bench, clips: Sequence[Clip]) -> tuple[list[dict[str, Found | None]], list[Grid]]:
    """Every source turned to either side."""
    found, grids = [], []
    for clip in tqdm(clips, desc="turned heads", unit="clip"):
        views, drawn = turn(bench.tracker, bench.embed, clip.source, clip.known, clip.persons)
        found += views
        rows = {
            name: [picture(clip.source), *(view[name].on_white for view in drawn)]
            for name in clip.persons
        }
        titles = ["source", *(f"{yaw:+.0f} degrees" for yaw in YAWS)]
        grids.append(Grid(clip.source.name, titles, rows))
    return found, grids


def crossing_grids(done: Sequence[Crossing]) -> list[Grid]:
    """One per source."""
    grids = []
    for name in dict.fromkeys(one.source.name for one in done):
        chosen = [one for one in done if one.source.name == name]
        rows: Rows = {
            "driver": [picture(chosen[0].source), *(picture(one.driver) for one in chosen)]
        }
        rows |= {method: [None, *(one.made[method] for one in chosen)] for method in chosen[0].made}
        titles = ["source", *(f"{one.driver.name}, {one.driver.number}" for one in chosen)]
        grids.append(Grid(name, titles, rows))
    return grids
