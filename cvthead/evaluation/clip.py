"""Everything that is measured on one clip alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cvthead.deformation import DeformationModel
from cvthead.errors import FaceError
from cvthead.evaluation.big_pose import big_pose_pairs
from cvthead.evaluation.identity import Embed, Vector
from cvthead.evaluation.methods import BALD, Method, Person
from cvthead.evaluation.metrics import Metrics, Score
from cvthead.evaluation.motion import Motion
from cvthead.evaluation.page import Grid, Rows
from cvthead.evaluation.reenactment import Reenactment, followed, picture, reenact
from cvthead.evaluation.shots import Shot, Take, read_take
from cvthead.evaluation.steadiness import Steadiness, follow_all, steadiness
from cvthead.evaluation.two_sources import likeness
from cvthead.evaluation.unseen import visibility
from cvthead.evaluation.videos import Video
from cvthead.points import PointLayout
from cvthead.tracking.tracker import TrackedFace, Tracker

# Drivers of other people that a clip gives.
LENT = 2


@dataclass(frozen=True, eq=False)
class Bench:
    """What all clips share.

    Attributes:
        tracker: judge of all methods, in the open head's coefficients.
        deformer, layout: of the same head.
        metrics: picture distances.
        methods: under test and baselines, by name.
        trained: names of those under test.
        embed: of CSIM; None without an embedder.
        drivers: driving frames per clip.
        parts: what to measure, of cvthead.evaluation.run.PARTS.
    """

    tracker: Tracker
    deformer: DeformationModel
    layout: PointLayout
    metrics: Metrics
    methods: Mapping[str, Method]
    trained: Sequence[str]
    embed: Embed | None
    drivers: int
    parts: frozenset[str]

    def persons(self, source: Shot, *, bald: bool = False) -> dict[str, Person] | None:
        """Prepared by every method; None if one of them finds no usable face in the source. The
        bald mesh only tells what the deformation is worth, so most measures do without it."""
        methods = {name: one for name, one in self.methods.items() if bald or name != BALD}
        try:
            return {name: prepare(source) for name, prepare in methods.items()}
        except FaceError:
            return None


@dataclass(frozen=True, eq=False)
class Clip:
    """Figures of one clip, and what the measures across clips need of it.

    Attributes:
        identity: whose face it shows.
        source: the first frame in which a face can be tracked.
        persons: made of it, without the bald mesh.
        lent: frames that drive other people, tracked with their own shape.
        known: embedding of the source; None without an embedder.
        same: cosines between the source and other frames.
        reenacted: by later frames.
        motion: by trained method, what each driver does and what its result does.
        far: reenacted with big differences of pose.
        far_found: frame pairs that far apart.
        steadiness, likeness: None if not measured.
        grids: pictures for the page.
    """

    identity: str
    source: Shot
    persons: Mapping[str, Person]
    lent: Sequence[Shot]
    known: Vector | None
    same: Sequence[float]
    reenacted: Sequence[Reenactment]
    motion: Mapping[str, Sequence[tuple[Motion, Motion | None]]]
    far: Sequence[Reenactment]
    far_found: int
    steadiness: Steadiness | None
    likeness: Mapping[str, Score] | None
    grids: Mapping[str, Grid]


def measure_clip(bench: Bench, video: Video) -> Clip | None:
    """Measure one clip; None if its face cannot be tracked in two frames.

    Raises:
        VideoError: the file cannot be read.
    """
    take = read_take(bench.tracker, video.path, video.name)
    if take is None:
        return None
    numbers = take.spread(bench.drivers)
    drivers = [shot for n in numbers if (shot := take.driver(bench.tracker, n)) is not None]
    every = bench.persons(take.source, bald=True)
    if every is None or not drivers:
        return None
    source, parts = take.source, bench.parts
    persons = {name: person for name, person in every.items() if name != BALD}
    grids: dict[str, Grid] = {}
    reenacted: list[Reenactment] = []
    motion: dict[str, list[tuple[Motion, Motion | None]]] = {name: [] for name in bench.trained}
    if "self" in parts:
        reenacted, motion, grids["self"] = _reenacted(bench, source, every, drivers)
    faces = follow_all(bench.tracker, take) if parts & {"big", "steady"} else []
    far, far_found, far_grids = _far(bench, take, faces) if "big" in parts else ([], 0, {})
    known, same = None, []
    if bench.embed:
        known = bench.embed(source.image, source.face)
        same = [float(known @ bench.embed(one.image, one.face)) for one in drivers]
    lent = (drivers[len(drivers) // 2], drivers[-1])[-LENT:]
    return Clip(
        video.identity,
        source,
        persons,
        lent,
        known,
        same,
        reenacted,
        motion,
        far,
        far_found,
        steadiness(bench.tracker, take, faces, persons) if "steady" in parts else None,
        _likeness(bench, take, persons, drivers, grids) if "sources" in parts else None,
        grids | far_grids,
    )


def _reenacted(
    bench: Bench, source: Shot, persons: Mapping[str, Person], drivers: Sequence[Shot]
) -> tuple[list[Reenactment], dict[str, list[tuple[Motion, Motion | None]]], Grid]:
    visible = visibility(bench.deformer, bench.layout)(source)
    done = [reenact(bench.metrics, persons, visible, driver) for driver in drivers]
    motion = {
        name: [
            followed(bench.tracker, source, driver, drawn[name])
            for driver, (_, drawn) in zip(drivers, done, strict=True)
        ]
        for name in bench.trained
    }
    shown = range(0, len(drivers), max(1, len(drivers) // 4))
    first = bench.trained[0]
    columns = [f"frame {drivers[i].number}, {done[i][0].scores[first].psnr:.1f} dB" for i in shown]
    rows: Rows = {"driver": [picture(source), *(picture(drivers[i]) for i in shown)]}
    rows |= {name: [None, *(done[i][1][name].on_white for i in shown)] for name in persons}
    grid = Grid(source.name, ["source", *columns], rows)
    return [figures for figures, _ in done], motion, grid


def _far(
    bench: Bench, take: Take, faces: Sequence[TrackedFace | None]
) -> tuple[list[Reenactment], int, dict[str, Grid]]:
    pairs = big_pose_pairs(take, faces)
    done: list[Reenactment] = []
    grids = {}
    for number, others in pairs.chosen.items():
        source = take.driver(bench.tracker, number)
        if source is None or (persons := bench.persons(source)) is None:
            continue
        visible = visibility(bench.deformer, bench.layout)(source)
        drivers = [shot for n in others if (shot := take.driver(bench.tracker, n)) is not None]
        results = [reenact(bench.metrics, persons, visible, driver) for driver in drivers]
        done += [figures for figures, _ in results]
        rows: Rows = {"driver": [picture(source), *map(picture, drivers)]}
        rows |= {name: [None, *(drawn[name].on_white for _, drawn in results)] for name in persons}
        titles = ["source", *(f"frame {driver.number}" for driver in drivers)]
        grids[f"big pose {number}"] = Grid(f"{take.name}, source frame {number}", titles, rows)
    return done, pairs.found, grids


def _likeness(
    bench: Bench,
    take: Take,
    persons: Mapping[str, Person],
    drivers: Sequence[Shot],
    grids: dict[str, Grid],
) -> Mapping[str, Score] | None:
    middle = take.driver(bench.tracker, len(take.frames) // 2)
    if middle is None or (others := bench.persons(middle)) is None:
        return None
    figures, drawn = likeness(bench.metrics, persons, others, drivers[-1])
    rows: Rows = {"driver": [picture(drivers[-1]), None]}
    rows |= {name: [one.on_white for one in pair] for name, pair in drawn.items()}
    grids["sources"] = Grid(take.name, ["of the first frame", "of the middle frame"], rows)
    return figures
