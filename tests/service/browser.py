"""Headless Chromium on the page, with a camera that plays a clip of the sample portrait."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from server_process import PORTRAIT

pytest.importorskip("playwright", reason="the page's tests need the package playwright")
from playwright.sync_api import Browser, Page, sync_playwright

FRAMES = 50
WIDTH, HEIGHT = 640, 480
NAMES = ("chromium", "chromium-browser", "google-chrome")
# A picture element's pixels, as a list: what somebody in front of the screen would see.
PIXELS = """(image) => {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [64, 64];
  const context = canvas.getContext("2d");
  context.drawImage(image, 0, 0, 64, 64);
  return Array.from(context.getImageData(0, 0, 64, 64).data);
}"""


def executable() -> str:
    """Path of the system's Chromium, or skip."""
    for name in NAMES:
        if path := shutil.which(name):
            return path
    pytest.skip("the page's tests need Chromium (Debian: apt install chromium)")


def camera_clip(path: Path) -> Path:
    """An MJPEG file of the sample portrait's head, tilting and moving; it loops without a jump."""
    image = cv2.imread(str(PORTRAIT))
    assert image is not None
    frames = []
    for phase in np.linspace(0, 2 * np.pi, FRAMES, endpoint=False):
        # Head and shoulders at the size of somebody at a desk.
        matrix = cv2.getRotationMatrix2D((225, 190), 12 * np.sin(phase), 1.6)
        matrix[:, 2] += np.array([WIDTH / 2 - 225 + 25 * np.sin(phase), HEIGHT / 2 - 160])
        frame = cv2.warpAffine(image, matrix, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
        frames.append(cv2.imencode(".jpg", frame)[1].tobytes())
    path.write_bytes(b"".join(frames))
    return path


@contextmanager
def chromium(clip: Path) -> Iterator[Browser]:
    """A browser whose camera plays ``clip`` and asks no questions."""
    program = executable()
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=program,
            args=[
                "--no-sandbox",  # containers run tests as root
                "--use-fake-ui-for-media-stream",
                "--use-fake-device-for-media-stream",
                f"--use-file-for-fake-video-capture={clip}",
            ],
        )
        try:
            yield browser
        finally:
            browser.close()


def pixels(page: Page) -> NDArray[np.int16]:
    """(64, 64, 4) RGBA of the picture on the page."""
    values = page.locator("#picture").evaluate(PIXELS)
    return np.array(values, np.int16).reshape(64, 64, 4)
