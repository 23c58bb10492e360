"""Networks that a user brings, here with seeded random weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_networks import SIZE, distance, features
from scipy import linalg

pytest.importorskip("torch")

from cvthead.errors import InputError
from cvthead.evaluation.metrics import Metrics
from cvthead.evaluation.paper_metrics import (
    UserNetworks,
    frechet_distance,
    paper_table,
    quality,
)
from cvthead.evaluation.picture_networks import PictureNetwork, as_batch


def pictures(seed: int, count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    shade = rng.integers(20, 200, (count, 1, 1, 3))
    noise = rng.integers(0, 56, (count, SIZE, SIZE, 3))
    return [*(shade + noise).astype(np.uint8)]


def test_frechet_distance_is_that_of_the_formula(tmp_path: Path) -> None:
    """Heusel et al., equation 6, by SciPy's matrix square root."""
    pytest.importorskip("torchmetrics")
    network = PictureNetwork.load(features(tmp_path / "fid.onnx", 4))
    real, made = pictures(1, 12), pictures(2, 9)
    found = [network(as_batch(np.stack(group))).astype(np.float64) for group in (real, made)]
    (mu, sigma), (nu, tau) = [(f.mean(0), np.cov(f, rowvar=False)) for f in found]
    root = linalg.sqrtm(sigma @ tau).real
    wanted = float(((mu - nu) ** 2).sum() + np.trace(sigma + tau - 2 * root))
    assert frechet_distance(network, real, made) == pytest.approx(wanted, rel=1e-3)
    assert frechet_distance(network, real, real) == pytest.approx(0, abs=1e-4 * wanted)


def test_lpips_is_measured_by_the_users_network(tmp_path: Path) -> None:
    metrics = Metrics(lpips=PictureNetwork.load(distance(tmp_path / "lpips.onnx"), inputs=2))
    black = np.zeros((SIZE, SIZE, 3), np.float32)
    mask, valid = np.ones((SIZE, SIZE), np.float32), np.ones((SIZE, SIZE), bool)
    scores = metrics.scores([black + np.float32(0.25), black], black, mask, valid)
    # A quarter of the range of 0..1 is half a unit of -1..1.
    assert [score.lpips for score in scores] == pytest.approx([0.25, 0])


def test_paper_table_names_what_is_absent(tmp_path: Path) -> None:
    pytest.importorskip("torchmetrics")
    made = {"A": pictures(1, 3)}
    speeds = {"A": np.array([2.5, 20.0])}
    none = UserNetworks.load()
    bare = paper_table(none, pictures(2, 3), made, {"A": []}, speeds)
    assert bare.rows["A"] == (None, None, None, 2.5)
    assert "| A | absent | absent | absent | 2.5 |" in bare.markdown()
    assert paper_table(none, pictures(2, 3), made, {"A": []}, {}).rows["A"][3] is None

    brought = UserNetworks.load(
        fid=features(tmp_path / "fid.onnx", 2), iqa=features(tmp_path / "iqa.onnx", 1)
    )
    table = paper_table(brought, pictures(2, 3), made, {"A": []}, speeds)
    fid, csim, iqa = table.rows["A"][:3]
    assert fid is not None
    assert fid > 0
    assert csim is None
    assert brought.iqa is not None
    assert iqa == pytest.approx(quality(brought.iqa, made["A"]))


def test_wrong_networks_are_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"no network")
    for path in (broken, tmp_path / "missing.onnx"):
        with pytest.raises(InputError, match="cannot be opened"):
            PictureNetwork.load(path)
    one = features(tmp_path / "one.onnx", 2)
    with pytest.raises(InputError, match="1 inputs, expected 2"):
        UserNetworks.load(lpips=one)
    with pytest.raises(InputError, match="refuses a batch"):
        PictureNetwork.load(one)(np.zeros((1, 3, 64, 64), np.float32))
