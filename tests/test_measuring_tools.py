"""tools/latency_plot.py and tools/footprint.py: what they print, not how fast it is; and
tools/st_lpips_parts.py: that what it replaces or moves lies nearer to the target; and
tools/depth_errors.py: that it finds the depth by which a head was made too flat; and
tools/hidden_colours.py and tools/edge_on_colours.py: that they compare what they name alone, with
its true colour."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from cvthead import Pipeline
from cvthead.avatar import Avatar
from cvthead.camera import CROP_PIXELS
from cvthead.clear import doubtful_points
from cvthead.deformation import to_pixels
from cvthead.driving import at_neck
from cvthead.evaluation.methods import Drawn
from cvthead.evaluation.shots import Shot, shoot
from cvthead.head.model import Region
from cvthead.images import read_image
from cvthead.sample import SAMPLE
from cvthead.source import read_source
from tools import edge_on_colours
from tools.depth_errors import residuals
from tools.footprint import base_dependencies, resident_bytes, service_lines
from tools.hidden_colours import compared, guesses
from tools.latency_plot import measure, plot, table
from tools.st_lpips_parts import pictures, regions

TIMINGS = {1: {1: 20.0, 2: 40.0}, 2: {1: 10.0, 2: 30.0}}


def test_table_of_batches_and_threads() -> None:
    assert table(TIMINGS).splitlines() == [
        "| batch | 1 thread: ms | ms a frame | 2 threads: ms | ms a frame |",
        "| ---: | ---: | ---: | ---: | ---: |",
        "| 1 | 20.0 | 20.0 | 10.0 | 10.0 |",
        "| 2 | 40.0 | 20.0 | 30.0 | 15.0 |",
    ]


def test_plot_is_reproducible_svg(tmp_path: Path) -> None:
    for name in ("first.svg", "second.svg"):
        plot(TIMINGS, tmp_path / name)
    first = (tmp_path / "first.svg").read_bytes()
    assert ElementTree.fromstring(first).tag.endswith("svg")
    assert first == (tmp_path / "second.svg").read_bytes()


def test_the_frame_network_runs_in_batches() -> None:
    timings = measure((1,), (1, 2), runs=1)
    assert list(timings) == [1]
    assert list(timings[1]) == [1, 2]
    assert np.all(np.array(list(timings[1].values())) > 0)


def test_base_dependencies_are_those_of_the_package() -> None:
    names = {re.split(r"[^\w-]", requirement)[0] for requirement in base_dependencies()}
    assert {"numpy", "onnxruntime", "fastapi"} <= names
    assert "torch" not in names


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
def test_resident_memory() -> None:
    # Of another process: in this one the kernel may take back pages that old tests left.
    code = "block = b'x' * 10**8; print('ready', flush=True); input()"
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        assert 1e8 < resident_bytes(child.pid) < 1.5e8
        child.communicate(b"\n")


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
def test_the_service_is_started_measured_and_stopped(tmp_path: Path) -> None:
    lines = service_lines(tmp_path, "open", renders=2)
    patterns = [
        r"service ready after \d+\.\d s",
        r"resident when ready: \d+ MB",
        r"resident after one upload and 2 renders: \d+ MB",
        r"highest: \d+ MB",
    ]
    for line, pattern in zip(lines, patterns, strict=True):
        assert re.fullmatch(pattern, line)


@pytest.fixture(scope="module")
def shot(pipeline: Pipeline) -> Shot:
    found = shoot(pipeline.tracker, "sample", 0, read_image(SAMPLE))
    assert found is not None
    return found


def test_every_pixel_belongs_to_one_part_of_the_person(pipeline: Pipeline, shot: Shot) -> None:
    parts = list(regions(pipeline.head, shot).values())
    assert all(part.mean() > 0.05 for part in parts)
    assert (np.sum(parts, axis=0) == 1).all()


def test_parts_replaced_or_moved_lie_nearer_to_the_target(pipeline: Pipeline, shot: Shot) -> None:
    head = shot.head
    shifted = Drawn(np.roll(head.image, 3, axis=1), np.roll(head.mask, 3, axis=1))
    shown = pictures(pipeline.head, shot, shot, shifted)
    target = pictures(pipeline.head, shot, shot, Drawn(head.image, head.mask))["the result"]
    off = {name: float(np.abs(picture - target).mean()) for name, picture in shown.items()}
    assert off["copy of the source"] == 0
    assert off["moved: everything"] < 0.5 * off["the result"]
    replaced = [value for name, value in off.items() if name.startswith("replaced")]
    assert max(replaced) < off["the result"]
    blurred = [value for name, value in off.items() if name.startswith("the target")]
    assert 0 < blurred[0] < blurred[1] < blurred[2]


def test_a_part_that_lies_too_deep_asks_to_be_nearer(pipeline: Pipeline, avatar: Avatar) -> None:
    """An avatar drives another whose scalp was moved backwards."""
    scalp = pipeline.head.region == Region.SCALP
    offsets = avatar.deformation.offsets - np.array([0, 0, 0.03], np.float32) * scalp[:, None]
    flat = replace(avatar, deformation=replace(avatar.deformation, offsets=offsets))
    found = []
    for yaw in (-0.3, 0.3):
        wanted = avatar.coefficients.with_joints({"global": (0, yaw, 0)})
        wanted, camera = at_neck(pipeline.head, avatar.coefficients, wanted, avatar.camera)
        shown = pipeline.render_coefficients(avatar, wanted, camera).over((255, 255, 255))
        driver = shoot(pipeline.tracker, "turned", 0, shown)
        assert driver is not None
        for part, nearer, beside in residuals(pipeline, flat, driver):
            if part == "SCALP":
                found.append((nearer[0], beside[0]))
    across, beside = np.array(found).T
    assert 0.01 < (across * beside).sum() / (across**2).sum() < 0.05  # metres


def test_hidden_colours_are_compared_with_what_is_there(pipeline: Pipeline, shot: Shot) -> None:
    """A portrait, half of which is taken for hidden, is compared with itself."""
    layout, head = pipeline.layout, pipeline.head
    whole = read_source(pipeline.deformer, layout, shot.head)
    half = whole.clear.copy()
    half[: layout.vertices] &= head.template[:, 0] <= 0
    half[layout.vertices : layout.surface] &= head.template[layout.edges, 0].mean(1) <= 0
    errors = compared(pipeline, replace(whole, clear=half), shot)
    face = {name: errors["FACE", True, name] for name in ("across", "nearest", "both")}
    counts = {len(each) for each in face.values()}
    assert len(counts) == 1
    assert 500 < counts.pop() <= (whole.clear & ~half)[: layout.surface].sum()
    # The portrait is lit evenly, so what lies across is nearly right.
    assert 0 < face["across"].mean() < face["both"].mean() < face["nearest"].mean()
    assert not compared(pipeline, whole, shot)["FACE", True, "both"].size
    shown = whole.clear[: layout.surface]
    guessed = guesses(pipeline, whole)
    assert not guessed["both"][shown].any()
    assert guessed["nearest"][~shown].any(1).mean() > 0.9


def test_edge_on_colours_are_compared_where_a_driver_shows_them(
    pipeline: Pipeline, avatar: Avatar, shot: Shot
) -> None:
    """A wall shines through where the portrait shows the cheek edge-on; a turned head, rendered
    from the portrait as it was, does not show it."""
    layout = pipeline.layout
    wanted = avatar.coefficients.with_joints({"global": (0, 0.6, 0)})
    wanted, camera = at_neck(pipeline.head, avatar.coefficients, wanted, avatar.camera)
    shown = pipeline.render_coefficients(avatar, wanted, camera).over((255, 255, 255))
    driver = shoot(pipeline.tracker, "turned", 0, shown)
    assert driver is not None
    source = read_source(pipeline.deformer, layout, shot.head)
    _, doubtful = doubtful_points(layout, source.network_input, source.points, source.visible)
    column, row = to_pixels(source.points[doubtful], CROP_PIXELS)[:, :2].astype(int).T
    wall = np.zeros(source.head.mask.shape, np.uint8)
    wall[row, column] = 1
    tinted = shot.head.image.copy()
    tinted[cv2.dilate(wall, np.ones((3, 3), np.uint8)) > 0] = (0, 255, 0)
    beside = replace(source, head=replace(source.head, image=tinted))
    rows = {
        (part, look): errors
        for part, look, errors in edge_on_colours.compared(pipeline, beside, [driver])
    }
    own, lent = rows["face", "neither"].T
    assert len(own) > 20
    assert own.mean() > 1.4 * lent.mean()  # of those that lend, some are hit by the wall as well
    assert not len(rows["face", "skin"])
