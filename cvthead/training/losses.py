"""Reconstruction losses (paper section 3.5): of the open preset, and as the paper has them."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvthead.training.details import ZOOM_SIDE

WINDOW = 0.75  # side, as a share of the view's
ZOOM_SHARE = 0.3  # of the steps, whose perceptual loss sees enlarged eyes or mouths
TRUE_MASK_SHARE = 0.2  # of the steps, whose perceptual loss sees the colours under the true mask


def window(place: Tensor, size: int) -> tuple[slice, slice]:
    """Rows and columns of the part of a view that the perceptual loss sees: it is the dearest
    part of a training step, and a random window is right on average."""
    side = round(WINDOW * size)
    top, left = (int(x * (size - side) + 0.5) for x in place.tolist())
    return slice(top, top + side), slice(left, left + side)


def zoomed(image: Tensor, corners: Tensor) -> Tensor:
    """A square of each picture, as large as :func:`window` makes it.

    Args:
        image: (b, c, s, s).
        corners: (b, 2) top and left, see cvthead.training.details.zoom_corner.
    """
    side, size = round(ZOOM_SIDE * image.shape[-1]), round(WINDOW * image.shape[-1])
    parts = [
        one[:, top : top + side, left : left + side]
        for one, (top, left) in zip(image, corners.long().tolist(), strict=True)
    ]
    return F.interpolate(torch.stack(parts), (size, size), mode="bilinear", align_corners=False)


def composite(rgb: Tensor, mask: Tensor, background: Tensor) -> Tensor:
    return rgb * mask + background * (1 - mask)


def reconstruction_losses(
    rgb: Tensor, logits: Tensor, batch: dict[str, Tensor], perceptual: nn.Module
) -> dict[str, Tensor]:
    """Losses of rendered views against the driven frames.

    Args:
        rgb: (b, 3, s, s) in [-1, 1]; logits: (b, 1, s, s) of the mask.
        batch: image (b, 3, s, s) in 0..1, mask and valid (b, 1, s, s), background (b, 3, 1, 1),
            weight (b, 1, s, s) of each pixel; zoom (b, 2), see :func:`zoomed`; window (b, 3) in
            0..1: the first decides for all where the perceptual loss looks, and by which mask.
        perceptual: frozen distance network, (b, 3, h, w) twice -> (b,).

    Returns:
        Scalars l1, perceptual and dice. Pixels beyond the driven picture count nowhere.
    """
    target_mask, valid = batch["mask"], batch["valid"]
    background = batch["background"] * 2 - 1
    target = composite(batch["image"] * 2 - 1, target_mask, background)
    mask = torch.sigmoid(logits)
    own = composite(rgb, mask, background)
    # Colour under the true mask as well, or a wrong mask would hide wrong colour.
    painted = composite(rgb, target_mask, background)
    weight = valid * batch["weight"]
    area = (weight.sum() * 3).clamp(min=1)
    l1 = (((painted - target).abs() + 0.5 * (own - target).abs()) * weight).sum() / area
    place, kind = batch["window"][0, :2], batch["window"][0, 2]
    shown = (painted if kind > 1 - TRUE_MASK_SHARE else own) * valid + target * (1 - valid)
    if kind < ZOOM_SHARE:
        shown, compared = (zoomed(image, batch["zoom"]) for image in (shown, target))
    else:
        rows, columns = window(place, rgb.shape[-1])
        shown, compared = shown[..., rows, columns], target[..., rows, columns]
    return {
        "l1": l1,
        "perceptual": perceptual(shown, compared).float().mean(),
        "dice": dice(mask, target_mask, valid),
    }


def paper_losses(
    rgb: Tensor, logits: Tensor, batch: dict[str, Tensor], perceptual: nn.Module, stage: int
) -> dict[str, Tensor]:
    """The same terms as the paper has them: over the whole view, every pixel alike.

    Args:
        rgb, logits, batch, perceptual: as in :func:`reconstruction_losses`.
        stage: 1 or 2, see :func:`compared_views`.
    """
    shown, target = compared_views(rgb, logits, batch, stage)
    return {
        "l1": (shown - target).abs().mean(),
        "perceptual": perceptual(shown, target).float().mean(),
        "dice": dice(torch.sigmoid(logits), batch["mask"], batch["valid"]),
    }


def compared_views(
    rgb: Tensor, logits: Tensor, batch: dict[str, Tensor], stage: int
) -> tuple[Tensor, Tensor]:
    """Rendered and true views over the random background, (b, 3, s, s) in [-1, 1] each.

    The rendered one is cut out by the predicted mask in stage 1 and by the true mask in stage 2,
    as in the released code. Beyond the driven picture both are equal.
    """
    background = batch["background"] * 2 - 1
    target = composite(batch["image"] * 2 - 1, batch["mask"], background)
    mask = torch.sigmoid(logits) if stage == 1 else batch["mask"]
    valid = batch["valid"]
    return composite(rgb, mask, background) * valid + target * (1 - valid), target


def dice(mask: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Dice loss of masks (b, 1, s, s) in 0..1 where ``valid`` is 1."""
    overlap = (mask * target * valid).sum()
    sizes = ((mask.square() + target.square()) * valid).sum()
    return 1 - 2 * overlap / sizes.clamp(min=1)
