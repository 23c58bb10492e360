from __future__ import annotations

import itertools
import math
from dataclasses import astuple, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from cvthead.errors import CVTHeadError  # noqa: E402
from cvthead.evaluation.groups import Reconstruction, group_tables  # noqa: E402
from cvthead.evaluation.metrics import (  # noqa: E402
    C1,
    PSNR_CAP,
    SCALE_WEIGHTS,
    Metrics,
    RegionError,
    l1,
    ms_ssim,
    on_white,
    psnr,
    tensor,
)
from cvthead.evaluation.reenactment import Reenactment, score_table  # noqa: E402
from cvthead.evaluation.two_sources import likeness_table  # noqa: E402
from cvthead.images import read_image  # noqa: E402
from cvthead.training.perceptual import STLPIPS  # noqa: E402

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"

SIZE = 192
EVERYWHERE = np.ones((SIZE, SIZE), dtype=bool)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    """Smooth colour gradients with edges, float32 in 0..1."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32) / SIZE
    discs = ((x - 0.5) ** 2 + (y - 0.4) ** 2 < 0.08).astype(np.float32)
    waves = 0.5 + 0.5 * np.sin(40 * x) * np.cos(25 * y)
    return np.stack([0.3 + 0.5 * discs, 0.8 * waves, 0.2 + 0.6 * x], axis=-1).astype(np.float32)


@pytest.fixture(scope="module")
def metrics() -> Metrics:
    try:
        return Metrics(STLPIPS("alex"))
    except CVTHeadError as error:
        pytest.skip(f"no perceptual weights: {error}")


def noisy(picture: np.ndarray, amount: float) -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=picture.shape)
    return np.clip(picture + amount * noise, 0, 1).astype(np.float32)


def test_equal_pictures_are_perfect(metrics: Metrics, picture: np.ndarray) -> None:
    score = metrics.scores([picture], picture, np.ones((SIZE, SIZE), np.float32), EVERYWHERE)[0]
    assert score.l1 == 0
    assert score.psnr == PSNR_CAP
    assert score.st_lpips == 0
    assert score.ms_ssim == pytest.approx(1, abs=1e-6)


def test_every_metric_worsens_with_noise(metrics: Metrics, picture: np.ndarray) -> None:
    results = [noisy(picture, amount) for amount in (0.02, 0.05, 0.1, 0.2)]
    scores = metrics.scores(results, picture, np.ones((SIZE, SIZE), np.float32), EVERYWHERE)
    for better, worse in itertools.pairwise(scores):
        assert better.l1 < worse.l1
        assert better.psnr > worse.psnr
        assert better.st_lpips is not None
        assert worse.st_lpips is not None
        assert better.st_lpips < worse.st_lpips
        assert better.ms_ssim > worse.ms_ssim


def test_several_results_score_as_each_alone(metrics: Metrics, picture: np.ndarray) -> None:
    mask = np.ones((SIZE, SIZE), np.float32)
    results = [noisy(picture, 0.1), picture[::-1].copy()]
    together = metrics.scores(results, picture, mask, EVERYWHERE)
    for result, score in zip(results, together, strict=True):
        alone = metrics.scores([result], picture, mask, EVERYWHERE)[0]
        assert astuple(score)[:4] == pytest.approx(astuple(alone)[:4], rel=1e-4)


def test_without_perceptual_weights_their_figure_alone_is_absent(
    metrics: Metrics, picture: np.ndarray
) -> None:
    results, mask = [noisy(picture, 0.1)], np.ones((SIZE, SIZE), np.float32)
    (bare,) = Metrics().scores(results, picture, mask, EVERYWHERE)
    (whole,) = metrics.scores(results, picture, mask, EVERYWHERE)
    assert whole.st_lpips is not None
    assert bare == replace(whole, st_lpips=None)

    row = f"| A | {bare.l1:.4f} | {bare.psnr:.2f} | absent | {bare.ms_ssim:.4f} |"
    done = Reenactment("clip", 1, {"A": bare}, {"A": bare}, {}, person=1)
    assert row in score_table("key", "Caption.", [done]).markdown()
    assert likeness_table([{"A": bare}]).rows["A"] == (bare.psnr, None)
    (table,) = group_tables([Reconstruction("x", {"A": bare}, {"A": whole})], 1)
    assert table.rows["x"][2] is None
    assert table.rows["x"][5] == pytest.approx(whole.st_lpips)


def test_pixels_beyond_the_frame_never_count(metrics: Metrics, picture: np.ndarray) -> None:
    valid = EVERYWHERE.copy()
    valid[:, :40] = False
    mask = np.ones((SIZE, SIZE), np.float32)
    result = noisy(picture, 0.1)
    altered = result.copy()
    altered[:, :40] = 1 - altered[:, :40]
    first, second = metrics.scores([result, altered], picture, mask, valid)
    assert first == second
    seen, _ = metrics.scores([altered, result], picture, mask, EVERYWHERE)
    assert seen.psnr < first.psnr


def test_l1_counts_the_person_only(picture: np.ndarray) -> None:
    mask = np.zeros((SIZE, SIZE), np.float32)
    mask[50:100] = 1
    result = picture.copy()
    result[50:100] += 0.25
    result[:50] += 0.5
    assert l1(result, picture, mask, EVERYWHERE) == pytest.approx(0.25, abs=1e-6)
    assert l1(result, picture, np.zeros_like(mask), EVERYWHERE) == 0


@pytest.mark.parametrize(("offset", "decibels"), [(0.1, 20.0), (0.01, 40.0), (1.0, 0.0)])
def test_psnr_of_a_constant_offset(offset: float, decibels: float) -> None:
    black = np.zeros((SIZE, SIZE, 3), np.float32)
    assert psnr(black + np.float32(offset), black, EVERYWHERE) == pytest.approx(decibels, abs=1e-3)


def test_ms_ssim_of_constant_pictures_is_the_luminance_term() -> None:
    a, b = 0.2, 0.7
    luminance = (2 * a * b + C1) / (a * a + b * b + C1)
    flat = torch.ones(1, 3, SIZE, SIZE, dtype=torch.float64)
    assert ms_ssim(a * flat, b * flat).item() == pytest.approx(
        luminance ** SCALE_WEIGHTS[-1], abs=1e-6
    )


def test_ms_ssim_is_symmetric_and_bounded(picture: np.ndarray) -> None:
    a = torch.from_numpy(picture).permute(2, 0, 1)[None]
    b = torch.from_numpy(noisy(picture, 0.3)).permute(2, 0, 1)[None]
    assert ms_ssim(a, b).item() == pytest.approx(ms_ssim(b, a).item(), abs=1e-6)
    assert 0 < ms_ssim(a, b).item() < 1


@pytest.fixture(scope="module")
def altered() -> tuple[np.ndarray, list[np.ndarray]]:
    """A real picture (256, 256, 3), and the same with noise, blurred and shifted."""
    resized = cv2.resize(read_image(PORTRAIT), (256, 256), interpolation=cv2.INTER_AREA)
    real = (resized / 255).astype(np.float32)
    return real, [noisy(real, 0.1), cv2.GaussianBlur(real, (0, 0), 3), np.roll(real, 4, axis=1)]


def test_psnr_is_that_of_torchmetrics(altered: tuple[np.ndarray, list[np.ndarray]]) -> None:
    image = pytest.importorskip("torchmetrics.functional.image")
    real, others = altered
    valid = np.ones((256, 256), dtype=bool)
    valid[:40] = False
    for other in others:
        kept = torch.from_numpy(other[valid]), torch.from_numpy(real[valid])
        wanted = float(image.peak_signal_noise_ratio(*kept, data_range=1.0))
        assert psnr(other, real, valid) == pytest.approx(wanted, abs=1e-4)


def test_ms_ssim_is_close_to_that_of_torchmetrics(
    altered: tuple[np.ndarray, list[np.ndarray]],
) -> None:
    """Of grey pictures, so that the order of averaging over channels does not matter; what is
    left is torchmetrics' border at the smallest scale."""
    image = pytest.importorskip("torchmetrics.functional.image")
    real, others = altered
    grey = [one.mean(2, keepdims=True) for one in (real, *others)]
    for other in grey[1:]:
        pair = tensor([other]), tensor([grey[0]])
        wanted = image.multiscale_structural_similarity_index_measure(*pair, data_range=1.0)
        assert ms_ssim(*pair).item() == pytest.approx(float(wanted), abs=0.005)


def test_on_white_blends_by_the_mask() -> None:
    image = np.zeros((1, 3, 3), np.uint8)
    blended = on_white(image, np.array([[0, 0.25, 1]], np.float32))
    assert blended[0, :, 0].tolist() == [1, 0.75, 0]


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_perceptual_distance_of_shifted_pictures_is_small(name: str, picture: np.ndarray) -> None:
    """Shift tolerance: one pixel of shift costs far less than other content."""
    try:
        network = STLPIPS(name)  # type: ignore[arg-type]
    except CVTHeadError as error:
        pytest.skip(f"no perceptual weights: {error}")
    whole = torch.from_numpy(picture).permute(2, 0, 1)[None] * 2 - 1
    here, shifted = whole[..., 8:136, 8:136], whole[..., 9:137, 8:136]
    with torch.no_grad():
        near = network(here, shifted).item()
        far = network(here, here.flip(2)).item()
    assert 0 < near < far / 3


def test_perceptual_distance_agrees_with_the_mean_of_its_map(picture: np.ndarray) -> None:
    try:
        network = STLPIPS("alex")
    except CVTHeadError as error:
        pytest.skip(f"no perceptual weights: {error}")
    a = torch.from_numpy(picture).permute(2, 0, 1)[None] * 2 - 1
    b = a.flip(3)
    with torch.no_grad():
        total, place = network(a, b), network.spatial(a, b)
    assert place.shape == (1, 1, SIZE, SIZE)
    assert math.isclose(total.item(), place.mean().item(), rel_tol=0.05)


def test_perceptual_gradient_is_finite_on_flat_pictures() -> None:
    try:
        network = STLPIPS("alex", fused=True)
    except CVTHeadError as error:
        pytest.skip(f"no perceptual weights: {error}")
    a = torch.ones(1, 3, 128, 128, requires_grad=True)
    network(a, torch.zeros(1, 3, 128, 128)).sum().backward()
    assert a.grad is not None
    assert torch.isfinite(a.grad).all()


def test_error_of_a_region_counts_its_pixels_only(picture: np.ndarray) -> None:
    region = np.zeros((SIZE, SIZE), dtype=bool)
    region[:10, :10] = True
    result = picture + np.float32(0.5)
    result[region] = picture[region] + np.float32(0.1)
    error = RegionError.of(result, picture, region)
    assert error.count == 100
    assert error.l1 == pytest.approx(0.1, abs=1e-5)
    assert error.psnr == pytest.approx(20, abs=1e-3)


def test_region_errors_add_up_as_if_of_one_picture(picture: np.ndarray) -> None:
    left = np.zeros((SIZE, SIZE), dtype=bool)
    left[:, :30] = True
    result = noisy(picture, 0.1)
    parts = [RegionError.of(result, picture, region) for region in (left, ~left)]
    whole = RegionError.of(result, picture, EVERYWHERE)
    assert vars(parts[0] + parts[1]) == pytest.approx(vars(whole))
    assert whole.psnr == pytest.approx(psnr(result, picture, EVERYWHERE), abs=1e-4)
    assert math.isnan(RegionError(0, 0, 0).psnr)
