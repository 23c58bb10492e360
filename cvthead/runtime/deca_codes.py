"""What DECA's encoder says of a face, by name (Feng et al. 2021)."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

# Names and lengths of the codes in the order of the network's output. ``tex`` (texture) and
# ``light`` are not used by CVTHead. ``pose`` is the axis-angle of the global and the jaw joint.
CODES = {"shape": 100, "tex": 50, "exp": 50, "pose": 6, "cam": 3, "light": 27}


def split_codes(codes: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """(236,) -> the CODES by name, (length,) each."""
    ends = list(accumulate(CODES.values()))
    return dict(zip(CODES, np.split(codes, ends[:-1]), strict=True))
