"""Tables of the evaluation, as Markdown and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from cvthead.evaluation.metrics import Score
from cvthead.evaluation.motion import Agreement, agreements
from cvthead.evaluation.protocol import METHODS, Clip

UNITS = {"yaw": "degrees", "jaw": "degrees", "smile": "score 0..1", "gaze": "degrees"}


@dataclass(frozen=True)
class Report:
    """Figures over all clips.

    Attributes:
        scores: mean of the clips' means per method, composited by the target's mask.
        own_matte: the same, each result composited by its own mask.
        motion: agreement of re-tracked results with their drivers.
        lost: driving frames in whose result no face was found.
        frames: driving frames in all.
        clips: per clip and method the mean score by the target's mask.
    """

    scores: Mapping[str, Score]
    own_matte: Mapping[str, Score]
    motion: Mapping[str, Agreement]
    lost: int
    frames: int
    clips: Mapping[str, Mapping[str, Score]]

    @classmethod
    def of(cls, clips: Sequence[Clip]) -> Report:
        by_clip = {
            clip.name: {m: mean([d.scores[m] for d in clip.drivers]) for m in METHODS}
            for clip in clips
        }
        mattes = [{m: mean([d.own_matte[m] for d in c.drivers]) for m in METHODS} for c in clips]
        pairs = [[(d.wanted, d.got) for d in c.drivers if d.got is not None] for c in clips]
        frames = sum(len(clip.drivers) for clip in clips)
        return cls(
            scores={m: mean([clip[m] for clip in by_clip.values()]) for m in METHODS},
            own_matte={m: mean([clip[m] for clip in mattes]) for m in METHODS},
            motion=agreements(pairs),
            lost=frames - sum(map(len, pairs)),
            frames=frames,
            clips=by_clip,
        )

    def markdown(self) -> str:
        """Two score tables and the motion table."""
        counts = f"{len(self.clips)} clips, {self.frames} driving frames"
        return "\n".join(
            [
                f"{counts}. Source: first trackable frame of the clip.",
                "256 x 256 crop of 0.36 m; ST-LPIPS: AlexNet, spatial mean.",
                "",
                "Both pictures on white by the target's mask:",
                "",
                score_table(self.scores),
                "",
                "Each result on white by its own mask:",
                "",
                score_table(self.own_matte),
                "",
                f"Driver against the re-tracked result ({self.lost} of {self.frames} lost):",
                "",
                motion_table(self.motion),
                "",
            ]
        )

    def json(self) -> dict[str, Any]:
        """The same figures as plain JSON types; NaN becomes null."""
        return plain(asdict(self))  # type: ignore[no-any-return]


def mean(scores: Sequence[Score]) -> Score:
    return Score(*(float(np.mean([getattr(s, f.name) for s in scores])) for f in fields(Score)))


def score_table(scores: Mapping[str, Score]) -> str:
    rows = [
        "| method | L1 ↓ | PSNR ↑ | ST-LPIPS ↓ | MS-SSIM ↑ |",
        "| --- | --- | --- | --- | --- |",
    ]
    rows += [
        f"| {name} | {s.l1:.4f} | {s.psnr:.2f} | {s.st_lpips:.4f} | {s.ms_ssim:.4f} |"
        for name, s in scores.items()
    ]
    return "\n".join(rows)


def motion_table(motion: Mapping[str, Agreement]) -> str:
    rows = [
        "| motion | r over all frames | r within clips | mean error | driver's spread | unit |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    rows += [
        f"| {name} | {a.pooled:.3f} | {a.within:.3f} | {a.error:.3g} | {a.spread:.3g} "
        f"| {UNITS[name]} |"
        for name, a in motion.items()
    ]
    return "\n".join(rows)


def plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, float) and math.isnan(value):
        return None
    return value
