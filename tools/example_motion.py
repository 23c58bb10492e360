"""Writes ``examples/talk.json``: a made animation of a talking, smiling, turning head.

Run as ``python -m tools.example_motion examples/talk.json``.
"""

from __future__ import annotations

import argparse
import json
import math
from itertools import pairwise
from pathlib import Path

FPS = 25
SECONDS = 5
# Seconds, and weight of jawOpen, mouthFunnel and mouthSmile: syllables, a pause, a smile.
MOUTH = (
    (0.0, 0.00, 0.0, 0.0),
    (0.4, 0.00, 0.0, 0.0),
    (0.6, 0.45, 0.0, 0.0),
    (0.8, 0.10, 0.1, 0.0),
    (1.0, 0.30, 0.6, 0.0),
    (1.2, 0.05, 0.2, 0.0),
    (1.4, 0.55, 0.0, 0.1),
    (1.6, 0.15, 0.1, 0.1),
    (1.8, 0.35, 0.4, 0.0),
    (2.1, 0.00, 0.0, 0.0),
    (2.6, 0.00, 0.0, 0.2),
    (3.1, 0.10, 0.0, 0.9),
    (3.9, 0.10, 0.0, 0.9),
    (4.5, 0.00, 0.0, 0.1),
    (5.0, 0.00, 0.0, 0.0),
)
BLINKS = (0.3, 2.3, 4.4)  # seconds
BLINK_HALF = 0.14


def mouth(time: float) -> tuple[float, float, float]:
    """Weights of MOUTH at ``time``, with smooth passages."""
    for (start, *first), (end, *second) in pairwise(MOUTH):
        if time <= end:
            share = (1 - math.cos(math.pi * (time - start) / (end - start))) / 2
            jaw, funnel, smile = (a + share * (b - a) for a, b in zip(first, second, strict=True))
            return jaw, funnel, smile
    raise ValueError(time)


def frame(time: float) -> dict[str, object]:
    """Controls at ``time`` seconds; the last frame leads over to the first."""
    jaw, funnel, smile = mouth(time)
    blink = max(0.0, *(1 - abs(time - middle) / BLINK_HALF for middle in BLINKS))
    turn = 2 * math.pi * time / SECONDS
    weights = {
        "jawOpen": jaw,
        "mouthFunnel": funnel,
        "mouthSmileLeft": smile,
        "mouthSmileRight": smile,
        "cheekSquintLeft": smile / 2,
        "cheekSquintRight": smile / 2,
        "browInnerUp": 0.3 * smile,
        "eyeBlinkLeft": blink,
        "eyeBlinkRight": blink,
    }
    rotation = (0.08 * math.sin(2 * turn), 0.35 * math.sin(turn), 0.05 * math.sin(3 * turn))
    return {
        "arkit": {name: round(weight, 3) for name, weight in weights.items() if weight > 0.0005},
        "global": [round(angle, 4) for angle in rotation],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    output = parser.parse_args().output
    lines = ",\n".join(json.dumps(frame(i / FPS)) for i in range(FPS * SECONDS))
    output.write_text(f'{{"fps": {FPS}, "frames": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    main()
