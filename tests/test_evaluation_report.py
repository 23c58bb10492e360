from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from cvthead.evaluation.metrics import RegionError, Score
from cvthead.evaluation.motion import Motion, agreements, correlation, motion_table
from cvthead.evaluation.page import Grid, tables, write_page
from cvthead.evaluation.reenactment import Reenactment, mean, paper_table, part_table, score_table
from cvthead.evaluation.report import Report
from cvthead.evaluation.table import Table
from cvthead.evaluation.unseen import HIDDEN, UNSEEN


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


def test_results_without_a_face_are_counted() -> None:
    table = motion_table("A", [[(motion(1), motion(2)), (motion(3), None)], [(motion(1), None)]])
    assert "2 of 3 lost" in table.caption


def test_absent_and_undefined_figures_look_different() -> None:
    table = Table("key", "Caption.", {"x": ".1f", "y": ".0%"}, {"A<b>": (1.25, None)}, "who")
    undefined = Table("key", "Caption.", {"x": ".1f"}, {"A": (math.nan,)})
    assert table.markdown().splitlines()[-1] == "| A<b> | 1.2 | absent |"
    assert undefined.markdown().splitlines()[-1] == "| A | - |"
    assert table.json()["rows"]["A<b>"] == {"x": 1.25, "y": None}
    assert undefined.json()["rows"]["A"] == {"x": None}


def test_mean_of_scores() -> None:
    found = mean([Score(0, 10, 0.25, 1, 0.5), Score(1, 20, 0.5, 0, 0.7)])
    assert vars(found) == pytest.approx(vars(Score(0.5, 15, 0.375, 0.5, 0.6)))
    assert mean([Score(0, 10, 0.25, 1, 0.5), Score(1, 20, 0.5, 0)]).lpips is None


def reenactment(clip: str, psnr: float, lpips: float | None = None) -> Reenactment:
    score = Score(0.01, psnr, 0.05, 0.75, lpips)
    part = {"A<b>": RegionError(absolute=0.3, squared=0.03, count=1)}
    parts = {UNSEEN: part, HIDDEN: {"A<b>": RegionError(0, 0, 0)}}
    return Reenactment(clip, 0, {"A<b>": score}, {"A<b>": score}, parts, person=10)


def test_every_clip_counts_the_same() -> None:
    done = [reenactment("a", 10), reenactment("a", 20), reenactment("b", 30)]
    assert score_table("k", "C.", done).rows["A<b>"][1] == pytest.approx(22.5)


def test_regions_are_pooled_and_their_share_stated() -> None:
    table = part_table("k", "C.", [reenactment("a", 10), reenactment("b", 10)])
    psnr, l1, hidden_psnr, hidden_l1 = table.rows["A<b>"]
    assert psnr == pytest.approx(20)
    assert l1 == pytest.approx(0.1)
    assert hidden_psnr is not None
    assert math.isnan(hidden_psnr)
    assert hidden_l1 is not None
    assert math.isnan(hidden_l1)
    assert "Unseen are 10.0% of the person's pixels, hidden 0.0%" in table.caption


def test_the_papers_figures_stand_below_ours() -> None:
    without = paper_table([reenactment("a", 20)], released=False)
    assert "| A<b> | 0.010 | 20.00 | absent | 0.750 |" in without.markdown()
    assert without.rows["CVTHead, paper, VoxCeleb1"] == (0.041, 22.09, 0.111, 0.84)
    assert without.rows["ROME, paper, VoxCeleb2"] == (0.05, 20.75, 0.117, 0.834)
    given = paper_table([reenactment("a", 20, 0.3)], released=False)
    assert given.rows["A<b>"][2] == pytest.approx(0.3)


def report() -> Report:
    table = score_table("self", "Both pictures on white:", [reenactment("v1", 17.25)])
    sections = {"Self": [table], "Empty": []}
    return Report(["One clip."], sections, {"Empty": "there is nothing"}, {"clips": 90})


def test_report_is_plain_json_without_nan() -> None:
    loaded = json.loads(json.dumps(report().json(), allow_nan=False))
    assert loaded["tables"]["self"]["rows"]["A<b>"]["PSNR ↑"] == 17.25
    assert loaded["tables"]["self"]["clips"]["A<b>"]["v1"]["lpips"] is None
    assert loaded["seconds"] == {"clips": 90}
    assert loaded["absent"] == {"Empty": "there is nothing"}


def test_report_tables_become_html_with_escaped_names() -> None:
    text = report().markdown()
    assert "## Self\n\nBoth pictures on white:\n\n| method |" in text
    assert "## Empty" not in text
    assert "\n\nEmpty: absent, there is nothing.\n\n" in text
    html = tables(text)
    assert "<td>A&lt;b&gt;</td><td>0.0100</td><td>17.25</td>" in html
    assert "<h2>Self</h2>" in html
    assert html.count("<table>") == html.count("</table>") == 1
    assert "---" not in html


def test_page_shows_every_picture_it_writes(tmp_path: Path) -> None:
    picture = np.full((32, 32, 3), 90, np.uint8)
    grid = Grid("<v1>", ["source", "frame 3"], {"driver": [picture, None], "A<b>": [None, picture]})
    page = write_page(tmp_path, report().markdown(), {"Big poses": [grid], "None": []})
    html = page.read_text("utf-8")
    written = sorted(path.name for path in (tmp_path / "images").iterdir())
    assert written == ["big-poses-0-0-0.jpg", "big-poses-0-1-1.jpg"]
    assert all(f'src="images/{name}"' in html for name in written)
    assert "<h3>&lt;v1&gt;</h3>" in html
    assert "<h2>None</h2>" not in html
