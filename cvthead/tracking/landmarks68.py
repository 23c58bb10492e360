"""The 68 classic landmarks (Sagonas et al., 300-W; also dlib's) picked from the 478.

Order, with left and right those of the subject: 0-16 jaw line from the right ear over the chin to
the left, 17-21 right brow and 22-26 left brow (image left to right), 27-30 nose bridge downward,
31-35 under the nose, 36-41 right eye and 42-47 left eye (clockwise on the screen, from the image
left corner), 48-59 outer lips and 60-67 inner lips (clockwise from the subject's right corner).

The two conventions do not mark the same spots everywhere: the jaw line of the 478 is the face oval
on the surface, that of the 68 the visible outline, so the two part on turned heads.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

# fmt: off
JAW_LINE = (127, 234, 93, 132, 58, 136, 150, 176, 152, 400, 379, 365, 288, 361, 323, 454, 356)
RIGHT_BROW = (70, 63, 105, 66, 107)
LEFT_BROW = (336, 296, 334, 293, 300)
NOSE_BRIDGE = (168, 197, 5, 4)
NOSE_BASE = (98, 97, 2, 326, 327)
RIGHT_EYE = (33, 160, 158, 133, 153, 144)
LEFT_EYE = (362, 385, 387, 263, 373, 380)
OUTER_LIPS = (61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181)
INNER_LIPS = (78, 82, 13, 312, 308, 317, 14, 87)
# fmt: on

LANDMARKS_68: Final[NDArray[np.int64]] = np.array(
    JAW_LINE
    + RIGHT_BROW
    + LEFT_BROW
    + NOSE_BRIDGE
    + NOSE_BASE
    + RIGHT_EYE
    + LEFT_EYE
    + OUTER_LIPS
    + INNER_LIPS,
    dtype=np.int64,
)
"""(68,) index into the 478 landmarks for every one of the 68."""
LANDMARKS_68.flags.writeable = False


def landmarks68(landmarks: NDArray[np.floating]) -> NDArray[np.floating]:
    """The 68 of (478, ...) landmarks, (68, ...)."""
    return landmarks[LANDMARKS_68]
