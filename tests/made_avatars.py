"""Made-up avatars, for tests that render nothing."""

from __future__ import annotations

from io import BytesIO

import numpy as np
from PIL import Image

from cvthead.avatar import Avatar
from cvthead.camera import Camera, Crop
from cvthead.coefficients import Coefficients
from cvthead.deformation import Deformation
from cvthead.preset import AnyAvatar


def jpeg(size: int = 256, mode: str = "RGB") -> bytes:
    out = BytesIO()
    Image.new(mode, (size, size), 90).save(out, "JPEG")
    return out.getvalue()


def png(size: int = 256, mode: str = "RGBA") -> bytes:
    out = BytesIO()
    Image.new(mode, (size, size)).save(out, "PNG")
    return out.getvalue()


def made_avatar(seed: int = 0, points: int = 50) -> Avatar:
    rng = np.random.default_rng(seed)
    return Avatar(
        rng.integers(0, 256, (points, 16)).astype(np.uint8),
        rng.normal(size=(points, 3)).astype(np.float16),
        rng.random(points) > 0.2,
        rng.integers(0, 256, (256, 256, 4)).astype(np.uint8),
        Deformation(
            rng.normal(size=(30, 3)).astype(np.float16).astype(np.float32),
            rng.integers(0, 30, 7).astype(np.int32),
            rng.normal(size=(7, 3)).astype(np.float16).astype(np.float32),
        ),
        Coefficients.zeros(),
        Camera(5.5, 0.01, -0.02),
        Crop(3.0, 4.0, 200.0),
        jpeg(),
        "open",
        f"{seed:016x}",
    )


def same(a: AnyAvatar, b: Avatar) -> bool:
    assert isinstance(a, Avatar)
    # Not the bytes of the files: safetensors orders its metadata at random.
    return plain(a) == plain(b) and all(map(np.array_equal, arrays(a), arrays(b)))


def plain(a: Avatar) -> tuple[object, ...]:
    return a.camera, a.crop, a.background, a.preset, a.fingerprint


def arrays(a: Avatar) -> tuple[np.ndarray, ...]:
    d, c = a.deformation, a.coefficients
    shell = d.shell_anchor, d.shell_offset
    points = a.descriptors, a.places, a.drawn
    return *points, a.portrait, d.offsets, *shell, c.shape, c.expression, c.pose
