"""Where the carried portrait's outline has come to lie within the person.

At its outline the portrait is mixed with what was behind it. When the head turns far, that outline
is carried across the side of the head and would draw a line there, in the background's colour.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.runtime.warp import reading_place

Array = NDArray[np.float32]
Codes = NDArray[np.uint8]

RIM_PIXELS = 128  # of the portrait's side
RIM = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))  # 4 pixels of 256
# 16 pixels of 256: nearer to the edge of the points, the rim is the person's own outline.
INSIDE = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (17, 17))


def outline_rim(portrait: Codes) -> Array:
    """How near each pixel is to what is not the person; depends on the portrait alone.

    Args:
        portrait: (S, S, 4), see Avatar.

    Returns:
        (RIM_PIXELS, RIM_PIXELS) from 0 well inside the person to 1.
    """
    # Where the segmentation is merely unsure there is no outline.
    person = (cv2.extractChannel(portrait, 3) > 127) * np.uint8(255)
    solid = cv2.erode(person, RIM)
    small = cv2.resize(solid, (RIM_PIXELS, RIM_PIXELS), interpolation=cv2.INTER_AREA)
    return np.asarray(1 - small / np.float32(255), np.float32)


def seams(flow: Array, rim: Array, covered: Codes) -> Array:
    """How much of the portrait's rim each pixel shows, deep within what points cover.

    Args:
        flow: (s, s, 2) from each pixel of the frame to the portrait, normalised.
        rim: of :func:`outline_rim`.
        covered: (s, s) 1 where points lie, else 0.

    Returns:
        (s, s), 0..1.
    """
    carried = cv2.remap(  # type: ignore[call-overload]
        rim, reading_place(flow, len(rim)), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(carried * cv2.erode(covered, INSIDE), np.float32)
