"""What the ST-LPIPS of self-reenactment is made of::

    python -m tools.st_lpips_parts DATA --every 3 --drivers 3

Each row changes one thing of the result and measures again. Pixels are replaced by the driving
frame's own, or moved to where optical flow finds them in it: what a row gains is what that part
costs. The last rows blur the driving frame itself: what sharpness alone is worth. Everything lies
on white by the target's mask, as in `cvthead evaluate`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cvthead.evaluation.methods import Drawn, trained
from cvthead.evaluation.metrics import Picture, on_white, tensor
from cvthead.evaluation.shots import Image, Shot
from cvthead.head.model import HeadModel
from cvthead.pipeline import Pipeline
from cvthead.training.perceptual import STLPIPS
from tools.clips import clip_arguments, clips

CHIN = 152  # of the face-mesh landmarks
BLURS = (0.5, 0.7, 1.0)  # sigma in pixels

Mask = NDArray[np.bool_]


def regions(head: HeadModel, driver: Shot) -> dict[str, Mask]:
    """(S, S) pixels of the driving frame by what its tracked head says they show."""
    size = driver.head.image.shape[0]
    vertices = head.vertices(driver.face.coefficients)
    landmarks = head.landmarks(driver.head.camera.project(vertices))
    pixels = np.rint((landmarks[:, :2] * 0.5 + 0.5) * size).astype(np.int32)
    filled = np.zeros((size, size), np.uint8)
    face = cv2.fillConvexPoly(filled, cv2.convexHull(pixels), 1) > 0
    below = (np.arange(size)[:, None] > pixels[CHIN, 1]) & ~face
    return {"the face": face, "below the chin": below, "hair and beside the face": ~face & ~below}


def moved(image: Image, flow: Picture) -> Image:
    """(S, S, 3) read at each pixel plus flow (S, S, 2)."""
    row, column = np.indices(image.shape[:2], np.float32)
    x, y = column + flow[..., 0], row + flow[..., 1]
    return np.asarray(
        cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def flow_between(target: Image, image: Image) -> Picture:
    """(S, S, 2) from the target's pixels to those of the image that show the same."""
    finder = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    finder.setFinestScale(0)
    grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (target, image)]
    return np.asarray(finder.calc(grey[0], grey[1], None), np.float32)  # type: ignore[call-overload]


def pictures(head: HeadModel, source: Shot, driver: Shot, drawn: Drawn) -> dict[str, Picture]:
    """(S, S, 3) on white, by what is changed."""
    target = driver.head
    wanted = on_white(target.image, target.mask)
    result = on_white(drawn.rgb, target.mask)
    own_target = Drawn(target.image, target.mask).on_white
    flow = flow_between(own_target, drawn.on_white)
    copy = Drawn(source.head.image, source.head.mask)
    copied = moved(copy.rgb, flow_between(own_target, copy.on_white))
    out = {"the result": result, "copy of the source": on_white(copy.rgb, target.mask)}
    parts = regions(head, driver)
    missing = (drawn.alpha < 0.5) & (target.mask > 0.5)
    for name, part in (parts | {"what its own mask leaves out": missing}).items():
        out[f"replaced: {name}"] = np.where(part[..., None], wanted, result)
    for name, part in (parts | {"everything": np.ones_like(missing)}).items():
        out[f"moved: {name}"] = on_white(moved(drawn.rgb, flow * part[..., None]), target.mask)
    out["moved: the copy"] = on_white(copied, target.mask)
    for sigma in BLURS:
        blurred = cv2.GaussianBlur(target.image, (0, 0), sigma).astype(np.uint8)
        out[f"the target, blurred by {sigma}"] = on_white(blurred, target.mask)
    return {name: np.where(target.valid[..., None], each, wanted) for name, each in out.items()}


def main(argv: Sequence[str] | None = None) -> None:
    parser = clip_arguments("python -m tools.st_lpips_parts", __doc__, drivers=3)
    parser.add_argument("--model", type=Path, help="another model folder than the packaged one")
    args = parser.parse_args(argv)
    pipeline = Pipeline.load(model=args.model)
    prepare, distance = trained(pipeline), STLPIPS("alex")
    found: dict[str, list[float]] = defaultdict(list)
    for shot, drivers in clips(pipeline.tracker, args):
        person = prepare(shot)
        for driver in drivers:
            shown = pictures(pipeline.head, shot, driver, person.follow(driver))
            wanted = tensor([on_white(driver.head.image, driver.head.mask)]) * 2 - 1
            with torch.no_grad():
                for name, picture in shown.items():
                    found[name].append(float(distance(tensor([picture]) * 2 - 1, wanted)))
    print(f"{len(found['the result'])} frames.\n\n| | ST-LPIPS |\n| --- | ---: |")
    for name, values in found.items():
        print(f"| {name} | {np.mean(values):.4f} |")


if __name__ == "__main__":
    main()
