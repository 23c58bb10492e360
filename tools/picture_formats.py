"""What encoding a frame costs in each library at hand: ``python -m tools.picture_formats``.

A frame of the sample portrait, RGBA for PNG and WebP, RGB for JPEG. Prints milliseconds and
kilobytes as Markdown. Run it on a quiet machine.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from cvthead.images import encode_image, read_image
from cvthead.pipeline import Pipeline
from cvthead.sample import SAMPLE

Image = NDArray[np.uint8]
RUNS = 40


def with_pillow(image: Image, kind: str, **options: object) -> bytes:
    data = io.BytesIO()
    Pillow.fromarray(image).save(data, kind, **options)
    return data.getvalue()


def with_opencv(image: Image, suffix: str, *options: int) -> bytes:
    order = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    return bytes(cv2.imencode(suffix, cv2.cvtColor(image, order), options)[1])


def main() -> None:
    pipeline = Pipeline.load()
    frame = pipeline.render(pipeline.encode(read_image(SAMPLE)))
    rgba, rgb = frame.rgba(), frame.over((255, 255, 255))
    ways: dict[str, Callable[[], bytes]] = {
        "PNG, cvthead (isal)": lambda: encode_image(rgba, "png"),
        "PNG, OpenCV, its default": lambda: with_opencv(rgba, ".png"),
        "PNG, Pillow, level 1": lambda: with_pillow(rgba, "PNG", compress_level=1),
        "JPEG, cvthead": lambda: encode_image(rgb, "jpeg"),
        "JPEG, OpenCV, 90": lambda: with_opencv(rgb, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 90),
        "JPEG, Pillow, 90": lambda: with_pillow(rgb, "JPEG", quality=90),
        "WebP, cvthead": lambda: encode_image(rgba, "webp"),
        "WebP, OpenCV, 90": lambda: with_opencv(rgba, ".webp", cv2.IMWRITE_WEBP_QUALITY, 90),
        "WebP, Pillow, 90, its default": lambda: with_pillow(rgba, "WEBP", quality=90),
    }
    print("| format, library | ms | kB |\n| --- | ---: | ---: |")
    for name, encode in ways.items():
        times = []
        for _ in range(RUNS):
            start = time.perf_counter()
            data = encode()
            times.append(time.perf_counter() - start)
        print(f"| {name} | {np.median(times) * 1e3:.2f} | {len(data) / 1000:.0f} |")


if __name__ == "__main__":
    main()
