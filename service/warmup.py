"""The first encoding and render, which are slow, done before the service says that it is ready."""

from __future__ import annotations

from typing import Any

from cvthead.images import encode_image, read_image
from cvthead.preset import Preset
from cvthead.sample import SAMPLE


def warm_up(pipeline: Preset[Any]) -> None:
    """Encode the sample portrait, render it and encode the picture."""
    encode_image(pipeline.render(pipeline.encode(read_image(SAMPLE))).rgba())
