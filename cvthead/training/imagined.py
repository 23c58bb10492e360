"""Views far from any picture: what a turned head shows according to its points alone.

Few pictures show one person from two sides far apart, and a network that never saw such a view
paints what it likes there. So some training views are composed: the portrait carried to the pose,
and where it shows nothing the colours of the points. They are no truth, but the most sober guess.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.clear import clear_points, own_colours
from cvthead.coefficients import Coefficients
from cvthead.crop import head_crop
from cvthead.driving import at_neck
from cvthead.head.model import HeadModel
from cvthead.hidden import hidden_colours
from cvthead.points import PointLayout
from cvthead.runtime.fill import ZERO
from cvthead.runtime.ghosts import point_owners
from cvthead.runtime.place import COLOURS, SOFT_EDGE, coded, place
from cvthead.runtime.seams import outline_rim
from cvthead.source import network_input, places, portrait_pixels

Array = NDArray[np.float32]

LARGEST_YAW = 70.0  # degrees from the front
NEAREST_YAW = 20.0  # degrees from the source's
LARGEST_PITCH = 12.0  # degrees
RIM = np.ones((5, 5), np.uint8)
SOFTNESS = 1.0  # of the outline: sigma in pixels
SPECKLED = 5  # pixels of the splat; seen and hidden points alternate at a border


def turned(
    rng: np.random.Generator, head: HeadModel, source: Coefficients, camera: Camera
) -> tuple[Coefficients, Camera]:
    """The source's face turned at random, its body with it in half of the cases; the camera sees
    it where every head crop has it."""
    about = cv2.Rodrigues(np.array([0, np.radians(_yaw(rng, source)), 0]))[0]
    pitch = np.radians(rng.uniform(-LARGEST_PITCH, LARGEST_PITCH))
    nod = cv2.Rodrigues(np.array([pitch, 0, 0]))[0]
    own = cv2.Rodrigues(source.joint("global").astype(np.float64))[0]
    wanted = source.with_joints({"global": cv2.Rodrigues(about @ nod @ own)[0].ravel()})
    seen = camera.in_crop(head_crop(head, wanted, camera))
    return at_neck(head, source, wanted, seen) if rng.random() < 0.5 else (wanted, seen)


def _yaw(rng: np.random.Generator, source: Coefficients) -> float:
    """Degrees to turn on by."""
    own = float(np.degrees(source.joint("global")[1]))
    low, high = -LARGEST_YAW - own, LARGEST_YAW - own
    left, right = max(0.0, -NEAREST_YAW - low), max(0.0, high - NEAREST_YAW)
    far = rng.uniform(0, left + right)
    return float(low + far if far < left else high - (far - left))


def imagined(
    layout: PointLayout,
    image: NDArray[np.uint8],
    mask: Array,
    source_points: Array,
    visible: NDArray[np.bool_],
    points: Array,
    size: int,
) -> tuple[Array, Array]:
    """What the points show of a source.

    Args:
        layout: numbering of the points.
        image, mask: (S, S, 3) and (S, S) of the source.
        source_points: (P, 3) its normalised projections.
        visible: (P,) those that it sees.
        points: (P, 3) driven projections.
        size: of the view.

    Returns:
        RGB (size, size, 3) and mask (size, size), both in 0..1.
    """
    network = network_input(image, mask)
    at = places(layout, source_points, visible)
    clear = clear_points(layout, network, source_points, visible)
    hidden = hidden_colours(layout, network, source_points, clear)
    colours = np.where(clear[:, None], own_colours(network, source_points), hidden)
    portrait = portrait_pixels(network)
    owners, rim = point_owners(at, visible), outline_rim(portrait)
    placed = place(layout, points, at, owners, rim, coded(colours, 1), portrait, size // 2)
    colour = cv2.medianBlur(np.ascontiguousarray(placed.codes[..., COLOURS]), SPECKLED)
    painted = cv2.resize(colour, (size, size), interpolation=cv2.INTER_LINEAR)
    carried = cv2.extractChannel(placed.warped, 3)
    # As far as points lie or the portrait shows the person, without the margin that a frame has.
    person = cv2.max(cv2.erode(placed.reach, SOFT_EDGE), carried)
    # The portrait's outline is mixed with what was behind it: no seam of that inside the person,
    # nor as near to its edge as cvthead.runtime.seams leaves it.
    inside = cv2.erode(person, RIM) == 255
    shown = np.where(inside, cv2.erode(carried, RIM), carried)[..., None] / np.float32(255)
    # The portrait is mixed with ZERO as far as it does not show the person.
    part = carried[..., None] / np.float32(255)
    pure = (placed.warped[..., :3] - ZERO * (1 - part)) / np.maximum(part, 1 / 255)
    rgb = (pure * shown + painted * (1 - shown)) / np.float32(255)
    soft = cv2.GaussianBlur(person, (0, 0), SOFTNESS) / np.float32(255)
    return np.clip(rgb, 0, 1).astype(np.float32), soft.astype(np.float32)
