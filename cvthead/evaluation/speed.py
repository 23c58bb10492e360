"""Frames per second as the paper counts them (section 4.2)."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvthead.driving import drive
from cvthead.evaluation.shots import Shot
from cvthead.evaluation.table import Table
from cvthead.preset import Preset

WARM_UP = 3
COLUMNS = {"FPS ↑": ".1f", "FPS, cached ↑": ".1f"}
PUBLISHED_FPS = 24.3


def frames_per_second(
    pipeline: Preset[Any], source: Shot, driver: Shot, runs: int, *, deform: bool = True
) -> NDArray[np.float64]:
    """Mean over ``runs`` runs; without ``deform`` hair and shoulders are left out.

    Returns:
        (2,): as the paper counts, each frame with the reconstruction of both heads, the
        deformation, the source's descriptors and the rendering; and with the source encoded once
        beforehand, as our commands and the service work.
    """
    seconds = np.zeros((WARM_UP + runs, 2))
    for run in seconds:
        start = time.perf_counter()
        avatar = pipeline.encode(source.image, deform=deform)
        encoded = time.perf_counter()
        face = pipeline.tracker.track(driver.image, shape=avatar.coefficients.shape)
        asked = drive(pipeline.head, avatar, face, crop=driver.head.crop)
        pipeline.render_coefficients(avatar, *asked)
        done = time.perf_counter()
        run[:] = done - start, done - encoded
    return np.asarray(1 / seconds[WARM_UP:].mean(axis=0))


def speed_table(speeds: Mapping[str, NDArray[np.float64]], runs: int) -> Table:
    """A row per method, and the paper's own figure.

    Args:
        speeds: by method, of :func:`frames_per_second`.
    """
    rows: dict[str, tuple[float | None, ...]] = {
        name: (float(paper), float(cached)) for name, (paper, cached) in speeds.items()
    }
    caption = (
        f"Frames per second, mean of {runs} runs: everything anew for every frame, as the paper "
        "counts, and with the source encoded once. The paper's figure is of an RTX 3090 Ti."
    )
    return Table("speed", caption, COLUMNS, rows | {"CVTHead, paper": (PUBLISHED_FPS, None)})
