"""The whole evaluation: clips, pairs of clips, stills, speed; then report and picture page."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cvthead.data.layout import Split
from cvthead.errors import FaceError, InputError, VideoError
from cvthead.evaluation.across import CROSS, cross_tables
from cvthead.evaluation.big_pose import DEGREES
from cvthead.evaluation.clip import Bench, Clip, measure_clip
from cvthead.evaluation.groups import (
    Reconstruction,
    Still,
    group_tables,
    read_stills,
    reconstruct,
    shots_of,
)
from cvthead.evaluation.motion import motion_table
from cvthead.evaluation.page import Grid, write_page
from cvthead.evaluation.paper_metrics import UserNetworks
from cvthead.evaluation.reenactment import paper_table, part_table, score_table
from cvthead.evaluation.report import Report
from cvthead.evaluation.speed import frames_per_second, speed_table
from cvthead.evaluation.steadiness import STRETCH, steadiness_table
from cvthead.evaluation.sweep import sweep
from cvthead.evaluation.table import Table
from cvthead.evaluation.two_sources import likeness_table
from cvthead.evaluation.videos import find_videos
from cvthead.files import write_file
from cvthead.head.arkit import ArkitMap
from cvthead.preset import Preset

T = TypeVar("T")

SELF, BIG, STEADY, SPEED = "Self-reenactment", "Big poses", "Steadiness", "Speed"
SOURCES, GROUPS, SWEEP = "Two sources of one person", "Groups", "Sweep"
# Of the parts that can come to nothing: heading, and why.
NOTHING = {
    "big": (BIG, f"no clip has two frames more than {DEGREES:.0f} degrees apart"),
    "cross": (CROSS, "it takes clips of two people with a trackable face"),
    "steady": (STEADY, f"no clip shows a trackable face in {STRETCH} frames in a row"),
    "sources": (SOURCES, "no clip shows a trackable face in its middle frame"),
    "groups": (GROUPS, "the data holds no stills.csv, or no still of its split val is trackable"),
}


@dataclass(frozen=True)
class Plan:
    """How much is measured.

    Attributes:
        data: folder with clips/val and stills/val, or of videos.
        split: see cvthead.evaluation.videos.find_videos.
        output: folder for the report and the page.
        every: take every n-th clip and still.
        crossings: drivers of other people per source.
        runs: of the measurement of speed.
        people: shown on the page.
    """

    data: Path
    split: Split | None
    output: Path
    every: int
    crossings: int
    runs: int
    people: int


def evaluate(
    plan: Plan,
    bench: Bench,
    pipelines: Mapping[str, Preset[Any]],
    bald: Collection[str],
    networks: UserNetworks,
) -> Report:
    """Measure, and write ``index.html``, ``report.md`` and ``report.json``.

    Args:
        pipelines: whose speed is measured, by method.
        bald: those of them that are run without hair and shoulders.

    Raises:
        InputError: as find_videos, no clip in which a face can be tracked, or a damaged table of
            stills.
    """
    seconds: dict[str, float] = {}
    stills = read_stills(plan.data) if "groups" in bench.parts else []
    clips = timed(seconds, "clips", lambda: measure_clips(bench, plan))
    sections = clip_sections(bench, clips)
    grids = clip_grids(clips, plan.people)
    speeds: dict[str, NDArray[np.float64]] = {}
    if "speed" in bench.parts:
        speeds = timed(
            seconds, "speed", lambda: measure_speed(clips[0], pipelines, bald, plan.runs)
        )
        sections[SPEED] = [speed_table(speeds, plan.runs)]
    if "cross" in bench.parts:
        tables, pictures = timed(
            seconds,
            "cross-identity",
            lambda: cross_tables(bench, clips, plan.crossings, networks, speeds),
        )
        sections |= tables
        grids |= {heading: some[: plan.people] for heading, some in pictures.items()}
    if "groups" in bench.parts:
        some = stills[:: plan.every]
        sections[GROUPS] = timed(seconds, "groups", lambda: measure_groups(bench, some))
    if "self" in bench.parts:
        arkit = pipelines[bench.trained[0]].arkit
        grids[SWEEP] = sweeps(bench.trained[0], arkit, spread(clips, plan.people))
    report = Report(about(bench, clips), sections, absent(bench.parts, sections), seconds)
    plan.output.mkdir(parents=True, exist_ok=True)
    write_file(plan.output / "report.md", report.markdown().encode())
    text = json.dumps(report.json(), indent=1, allow_nan=False)
    write_file(plan.output / "report.json", text.encode())
    write_page(plan.output, report.markdown(), grids)
    return report


def timed(seconds: dict[str, float], part: str, work: Callable[[], T]) -> T:
    """The result of ``work``; its seconds are noted under ``part``."""
    start = time.perf_counter()
    result = work()
    seconds[part] = time.perf_counter() - start
    return result


def measure_clips(bench: Bench, plan: Plan) -> list[Clip]:
    """Every n-th clip; those that cannot be read or show no trackable face are left out.

    Raises:
        InputError: as find_videos, or none is left.
    """
    videos = find_videos(plan.data, plan.split)[:: plan.every]
    # Pictures fill the memory; only those of the people on the page are kept.
    shown = set(spread(videos, plan.people))
    clips = []
    for video in tqdm(videos, desc="clips", unit="clip"):
        try:
            clip = measure_clip(bench, video)
        except VideoError as error:
            tqdm.write(f"{video.path}: {error}")
            continue
        if clip is None:
            tqdm.write(f"{video.path}: no trackable face")
        else:
            clips.append(clip if video in shown else replace(clip, grids=big_only(clip.grids)))
    if not clips:
        raise InputError(
            f"no usable clips in {plan.data}", hint="pass videos that show a face in two frames"
        )
    return clips


def big_only(grids: Mapping[str, Grid]) -> dict[str, Grid]:
    """Big poses are few and the hardest: all are shown."""
    return {key: grid for key, grid in grids.items() if key.startswith("big")}


def spread(items: Sequence[T], count: int) -> list[T]:
    """At most ``count``, evenly spaced."""
    return list(items[:: max(1, len(items) // count)][:count])


def clip_sections(bench: Bench, clips: Sequence[Clip]) -> dict[str, list[Table]]:
    """Tables of what is measured on each clip alone."""
    sections: dict[str, list[Table]] = {}
    own = [one for clip in clips for one in clip.reenacted]
    if own:
        released = clips[0].persons[bench.trained[0]].preset == "official"
        sections[SELF] = [
            score_table("self-reenactment", "Both pictures on white by the target's mask:", own),
            score_table(
                "self-reenactment, own masks",
                "Each result on white by its own mask:",
                own,
                own=True,
            ),
            part_table("unseen", "Over the pixels alone that the source did not show.", own),
            paper_table(own, released=released),
            *(motion_table(name, [clip.motion[name] for clip in clips]) for name in bench.trained),
        ]
    far = [one for clip in clips for one in clip.far]
    if far:
        found = sum(clip.far_found for clip in clips)
        people = len({clip.identity for clip in clips if clip.far})
        caption = (
            f"Source and driver more than {DEGREES:.0f} degrees apart: {len(far)} pairs of "
            f"{people} people, evenly spread over the {found} that were found."
        )
        sections[BIG] = [
            score_table(
                "big poses", f"{caption} Both pictures on white by the target's mask:", far
            ),
            part_table("big poses, unseen", "Over the unseen pixels alone.", far),
        ]
    steady = [clip.steadiness for clip in clips if clip.steadiness is not None]
    if steady:
        sections[STEADY] = [steadiness_table(steady)]
    alike = [clip.likeness for clip in clips if clip.likeness is not None]
    if alike:
        sections[SOURCES] = [likeness_table(alike)]
    return sections


def clip_grids(clips: Sequence[Clip], people: int) -> dict[str, list[Grid]]:
    """Pictures by heading."""
    shown = [clip.grids for clip in clips]
    return {
        SELF: [grids["self"] for grids in shown if "self" in grids],
        BIG: [grid for grids in shown for key, grid in grids.items() if key.startswith("big")],
        SOURCES: [grids["sources"] for grids in shown if "sources" in grids][:people],
    }


def measure_speed(
    clip: Clip, pipelines: Mapping[str, Preset[Any]], bald: Collection[str], runs: int
) -> dict[str, NDArray[np.float64]]:
    """Of each trained method, with a source and a driver of one clip."""
    return {
        name: frames_per_second(pipeline, clip.source, clip.lent[-1], runs, deform=name not in bald)
        for name, pipeline in pipelines.items()
    }


def measure_groups(bench: Bench, stills: Sequence[Still]) -> list[Table]:
    """Same and mirrored picture of each still, by group."""
    done: list[Reconstruction] = []
    for still in tqdm(stills, desc="stills", unit="still"):
        shots = shots_of(bench.tracker, still)
        if shots is None:
            continue
        try:
            persons = {name: bench.methods[name](shots[0]) for name in bench.trained}
        except FaceError:
            continue
        done.append(reconstruct(bench.metrics, still.group, persons, *shots))
    return group_tables(done, len(stills)) if done else []


def sweeps(name: str, arkit: ArkitMap, clips: Sequence[Clip]) -> list[Grid]:
    """One method under a fixed series of poses and expressions.

    Args:
        arkit: of the method's own head model.
    """
    grids = []
    for clip in clips:
        person = clip.persons[name]
        pictures = sweep(person.head, arkit, person.coefficients, person.camera, person.draw)
        grids.append(Grid(clip.source.name, list(pictures), {name: [*pictures.values()]}))
    return grids


def absent(parts: Collection[str], sections: Mapping[str, Sequence[Table]]) -> dict[str, str]:
    """Heading -> why there is no table of a part that was asked for."""
    return {
        heading: reason
        for part, (heading, reason) in NOTHING.items()
        if part in parts and not sections.get(heading)
    }


def about(bench: Bench, clips: Sequence[Clip]) -> list[str]:
    frames = sum(len(clip.reenacted) for clip in clips)
    people = len({clip.identity for clip in clips})
    shared = f" of {people} people" if people < len(clips) else ""
    return [
        f"{len(clips)} clips{shared}, {frames} driving frames. Source: first trackable "
        "frame of the clip. 256 x 256 crop of 0.36 m; ST-LPIPS: AlexNet, spatial mean."
    ]
