from __future__ import annotations

import json
import math

import numpy as np
import pytest

pytest.importorskip("torch")

from cvthead.evaluation.metrics import Score
from cvthead.evaluation.motion import Motion, agreements, correlation
from cvthead.evaluation.page import tables
from cvthead.evaluation.report import Report, mean


def motion(yaw: float, jaw: float = 0.0) -> Motion:
    return Motion(yaw=yaw, jaw=jaw, smile=0.1, gaze=0.0)


def test_correlation_of_linear_series() -> None:
    x = np.array([1.0, 2.0, 4.0])
    assert correlation(x, 3 * x + 2) == pytest.approx(1)
    assert correlation(x, -x) == pytest.approx(-1)
    assert math.isnan(correlation(x, np.ones(3)))


def test_people_who_differ_do_not_count_as_motion_within_clips() -> None:
    """Each result keeps its source's yaw: only the differences between people correlate."""
    clips = [
        [(motion(base + turn), motion(base - turn / 10)) for turn in (-3.0, 0.0, 3.0)]
        for base in (-30.0, 0.0, 30.0)
    ]
    yaw = agreements(clips)["yaw"]
    assert yaw.pooled > 0.9
    assert yaw.within == pytest.approx(-1)
    assert yaw.error == pytest.approx(2.2)
    assert yaw.frames == 9


def test_a_perfect_result_agrees_wholly() -> None:
    clips = [[(motion(y, y / 2), motion(y, y / 2)) for y in (0.0, 5.0, 9.0)], []]
    found = agreements(clips)
    for name in ("yaw", "jaw"):
        assert found[name].within == pytest.approx(1)
        assert found[name].error == 0
    assert math.isnan(found["smile"].within)
    assert agreements([]) == {}


def report() -> Report:
    score = Score(0.0125, 17.25, 0.051, 0.75)
    return Report(
        scores={"A<b>": score},
        own_matte={"A<b>": score},
        motion=agreements([[(motion(1), motion(2)), (motion(3), motion(4))]]),
        lost=1,
        frames=3,
        clips={"v1": {"A<b>": score}},
    )


def test_report_is_plain_json_without_nan() -> None:
    text = json.dumps(report().json(), allow_nan=False)
    loaded = json.loads(text)
    assert loaded["scores"]["A<b>"]["psnr"] == 17.25
    assert loaded["motion"]["smile"]["within"] is None
    assert loaded["motion"]["yaw"]["within"] == pytest.approx(1)


def test_report_tables_become_html_with_escaped_names() -> None:
    html = tables(report().markdown())
    assert "<td>A&lt;b&gt;</td><td>0.0125</td><td>17.25</td>" in html
    assert html.count("<table>") == html.count("</table>") == 3
    assert "---" not in html


def test_mean_of_scores() -> None:
    found = mean([Score(0, 10, 0.25, 1), Score(1, 20, 0.5, 0)])
    assert found == Score(0.5, 15, 0.375, 0.5)
