"""A training record of the sample portrait, as one still or as a clip of several views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from cvthead.deformation import DeformationModel
from cvthead.images import read_image
from cvthead.points import PointLayout
from cvthead.source import HeadCrop, cut_head, read_source
from cvthead.tracking.tracker import Tracker
from cvthead.training import records

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"


def portrait_crop(tracker: Tracker) -> HeadCrop:
    image = read_image(PORTRAIT)
    return cut_head(tracker, image, tracker.track(image))


def make_records(folder: Path, *, views: int = 1) -> None:
    """One record in ``folder``: the portrait, and further views turned in the picture plane."""
    tracker = Tracker.load()
    image = read_image(PORTRAIT)
    height, width = image.shape[:2]
    first = tracker.track(image)
    heads = []
    for number in range(views):
        turn = cv2.getRotationMatrix2D((width / 2, height / 2), 5.0 * number, 1.0)
        turned = cv2.warpAffine(image, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
        face = tracker.track(turned.astype(np.uint8), shape=first.coefficients.shape)
        head = cut_head(tracker, turned.astype(np.uint8), face)
        shape = first.coefficients.shape
        heads.append(replace(head, coefficients=replace(head.coefficients, shape=shape)))
    deformer = DeformationModel.from_head(tracker.head)
    source = read_source(deformer, PointLayout.of(tracker.head), heads[0])
    records.write(folder / "portrait.npz", heads, {0: source})
