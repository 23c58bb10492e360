"""Image metrics of self-reenactment (paper section 4.2).

Both pictures are composited on white; pixels beyond the frame of the driving video are excluded:
they are left out of the averages of L1 and PSNR, and replaced by the target's own pixels before
the two metrics that look at neighbourhoods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from cvthead.evaluation.picture_networks import PictureNetwork
from cvthead.training.perceptual import STLPIPS

Picture = NDArray[np.float32]

PSNR_CAP = 100.0

# Wang, Simoncelli and Bovik, "Multiscale structural similarity for image quality assessment".
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class Score:
    """Distance of one picture to its target.

    Attributes:
        l1: mean absolute difference over the person's pixels, 0..1.
        psnr: dB over all valid pixels, at most ``PSNR_CAP``.
        st_lpips: shift-tolerant LPIPS, AlexNet, spatial mean; None without its weights.
        ms_ssim: multi-scale structural similarity, at most 1.
        lpips: the user's own LPIPS network; None without one.
    """

    l1: float
    psnr: float
    st_lpips: float | None
    ms_ssim: float
    lpips: float | None = None


def on_white(image: NDArray[np.uint8], mask: Picture) -> Picture:
    """Composite an (H, W, 3) uint8 image on white by an (H, W) mask in 0..1: float32 in 0..1."""
    alpha = mask[..., None].astype(np.float32)
    white = np.float32(1)
    blended: Picture = image * (alpha / np.float32(255)) + (white - alpha)
    return blended


def l1(result: Picture, target: Picture, mask: Picture, valid: NDArray[np.bool_]) -> float:
    """Mean absolute difference weighted by the mask (H, W) inside the valid pixels."""
    weight = mask * valid
    total = float(weight.sum()) * result.shape[-1]
    return float((np.abs(result - target) * weight[..., None]).sum() / max(total, 1e-9))


def psnr(result: Picture, target: Picture, valid: NDArray[np.bool_]) -> float:
    """Peak signal-to-noise ratio in dB over the valid pixels, peak 1, capped at PSNR_CAP."""
    return min(PSNR_CAP, cv2.PSNR(result[valid], target[valid], 1.0))


def ms_ssim(a: Tensor, b: Tensor) -> Tensor:
    """Multi-scale SSIM of (B, C, H, W) pictures in 0..1, sides above 160: (B,).

    Five scales, 11-tap Gaussian windows (sigma 1.5) that lie wholly inside the picture,
    average over channels at the end. torchmetrics averages the channels before it multiplies the
    scales, and reflects the borders of the last one, which changes up to several hundredths.
    """
    taps = torch.exp(
        -((torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2) ** 2) / (2 * SIGMA**2)
    )
    taps = (taps / taps.sum()).to(a)
    channels = a.shape[1]
    row = taps.expand(channels, 1, 1, -1)

    def smooth(x: Tensor) -> Tensor:
        return F.conv2d(F.conv2d(x, row, groups=channels), row.transpose(2, 3), groups=channels)

    product = torch.ones(len(a), channels).to(a)
    for scale, weight in enumerate(SCALE_WEIGHTS):
        if scale:
            a, b = F.avg_pool2d(a, 2), F.avg_pool2d(b, 2)
        mean_a, mean_b = smooth(a), smooth(b)
        covariance = smooth(a * b) - mean_a * mean_b
        variances = smooth(a * a) - mean_a**2 + smooth(b * b) - mean_b**2
        term = (2 * covariance + C2) / (variances + C2)
        if scale == len(SCALE_WEIGHTS) - 1:
            term = term * (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
        product = product * term.mean((2, 3)).clamp(min=0) ** weight
    return product.mean(1)


@dataclass(frozen=True)
class RegionError:
    """Errors added up over some pixels, so that pictures with few of them weigh little.

    Attributes:
        absolute: sum of absolute differences, 0..1 each, over pixels and channels.
        squared: sum of squared differences.
        count: of pixels.
    """

    absolute: float
    squared: float
    count: int

    @classmethod
    def of(cls, result: Picture, target: Picture, region: NDArray[np.bool_]) -> RegionError:
        """Of two (H, W, 3) pictures over the pixels where ``region`` (H, W) is true."""
        difference = (result - target)[region].astype(np.float64)
        absolute, squared = np.abs(difference).sum(), np.square(difference).sum()
        return cls(float(absolute), float(squared), int(region.sum()))

    def __add__(self, other: RegionError) -> RegionError:
        return RegionError(
            self.absolute + other.absolute, self.squared + other.squared, self.count + other.count
        )

    @property
    def l1(self) -> float:
        """Mean absolute difference, 0..1; NaN of no pixels."""
        return self.absolute / (3 * self.count) if self.count else float("nan")

    @property
    def psnr(self) -> float:
        """dB of the mean squared difference, at most PSNR_CAP; NaN of no pixels."""
        if not self.count:
            return float("nan")
        mean = max(self.squared / (3 * self.count), 1e-12)
        return min(PSNR_CAP, -10 * float(np.log10(mean)))


def tensor(pictures: Sequence[Picture]) -> Tensor:
    """(H, W, 3) pictures -> (B, 3, H, W)."""
    stacked = np.stack(pictures).astype(np.float32).transpose(0, 3, 1, 2)
    return torch.from_numpy(np.ascontiguousarray(stacked))


class Metrics:
    """The metrics of self-reenactment; holds the perceptual networks."""

    def __init__(
        self, perceptual: STLPIPS | None = None, lpips: PictureNetwork | None = None
    ) -> None:
        """
        Args:
            perceptual: without it, ST-LPIPS is absent.
            lpips: the user's; takes two batches of pictures. Without it, LPIPS is absent.
        """
        self.perceptual = perceptual
        self.lpips = lpips

    @torch.no_grad()
    def scores(
        self,
        results: Sequence[Picture],
        target: Picture,
        mask: Picture,
        valid: NDArray[np.bool_],
    ) -> list[Score]:
        """Score several pictures against one target.

        Args:
            results: (H, W, 3) float32 pictures in 0..1, composited on white.
            target: the same, of the driving frame.
            mask: (H, W) the target's person mask in 0..1.
            valid: (H, W) False beyond the driving video's frame; True somewhere.
        """
        filled = [np.where(valid[..., None], result, target) for result in results]
        batch, goal = tensor(filled), tensor([target])
        distance = self.perceptual(batch * 2 - 1, goal * 2 - 1) if self.perceptual else None
        similarity = ms_ssim(batch, goal.expand_as(batch))
        lpips = None
        if self.lpips:
            pair = batch.numpy() * 2 - 1, goal.expand_as(batch).numpy() * 2 - 1
            lpips = self.lpips(*pair)
        return [
            Score(
                l1(result, target, mask, valid),
                psnr(result, target, valid),
                None if distance is None else float(distance[i]),
                float(similarity[i]),
                None if lpips is None else float(lpips[i].mean()),
            )
            for i, result in enumerate(results)
        ]
