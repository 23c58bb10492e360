"""Faces in FLAME's coefficients: where the open tracker finds them, as DECA sees them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS, Camera, Crop
from cvthead.coefficients import Array, Coefficients
from cvthead.crop import head_crop
from cvthead.head.model import HeadModel
from cvthead.official.crop import FaceSquare
from cvthead.official.networks import Network
from cvthead.runtime.deca_codes import split_codes
from cvthead.tracking.landmarks68 import landmarks68
from cvthead.tracking.networks import Networks
from cvthead.tracking.tracker import TrackedFace, Tracker

Image = NDArray[np.uint8]
WHOLE = Crop(0.0, 0.0, float(CROP_PIXELS))


@dataclass(frozen=True, eq=False)
class Picture:
    """A 256 x 256 picture of a head, as the released model takes it.

    Attributes:
        pixels: (256, 256, 3) uint8 RGB.
        landmarks: (68, 2) in its pixels, the first pixel's centre at 0.
        crop: the square of a larger picture that it shows.
    """

    pixels: Image
    landmarks: NDArray[np.floating]
    crop: Crop = WHOLE

    @property
    def square(self) -> FaceSquare:
        return FaceSquare.around(self.landmarks)


@dataclass(frozen=True, eq=False)
class Estimate:
    """What one DECA pass says of a face: FLAME coefficients and its raw camera (3,)."""

    coefficients: Coefficients
    cam: Array


@dataclass(frozen=True, eq=False)
class OfficialFace(TrackedFace):
    """A tracked face whose coefficients and camera are DECA's, of FLAME.

    Attributes:
        found: the same face in the open head's coefficients, for the next frame's search.
    """

    found: TrackedFace


@dataclass(frozen=True, eq=False)
class OfficialTracker:
    """Immutable; safe to share between threads.

    Attributes:
        head: FLAME.
        finder: finds faces and landmarks.
        deca: DECA's encoder, see OfficialNetworks.
        rest_pose: (15,) axis-angle of the joints that DECA does not estimate.
    """

    head: HeadModel
    finder: Tracker
    deca: Network
    rest_pose: Array

    @property
    def networks(self) -> Networks:
        """The open tracker's face networks, which also score ARKit's blendshapes."""
        return self.finder.networks

    def track(
        self,
        image: Image,
        *,
        face: int | None = None,
        only_one: bool = False,
        shape: Array | None = None,
        previous: TrackedFace | None = None,
    ) -> OfficialFace:
        """One DECA pass for one face; arguments and errors as :meth:`Tracker.track`.

        ``shape`` is not used: DECA estimates it anew, and driving keeps the avatar's.
        """
        before = previous.found if isinstance(previous, OfficialFace) else None
        found = self.finder.track(image, face=face, only_one=only_one, previous=before)
        picture = self.cut(image, found)
        estimate = self.estimate(picture.pixels, picture.square)
        camera = _in_image(picture.square.camera(estimate.cam), picture.crop)
        kept = {field.name: getattr(found, field.name) for field in fields(TrackedFace)}
        kept |= {"coefficients": estimate.coefficients, "camera": camera}
        return OfficialFace(**kept, found=found)

    def picture(
        self,
        image: Image,
        *,
        face: int | None = None,
        only_one: bool = False,
        previous: TrackedFace | None = None,
    ) -> Picture:
        """The square around a head of any picture; arguments and errors as :meth:`track`."""
        found = self.finder.track(image, face=face, only_one=only_one, previous=previous)
        return self.cut(image, found)

    def cut(self, image: Image, found: TrackedFace, crop: Crop | None = None) -> Picture:
        """The head's own square of a picture, or another one that holds it."""
        crop = crop or head_crop(self.finder.head, found.coefficients, found.camera)
        pixels, _ = crop.cut(image)
        landmarks = landmarks68(found.landmarks)[:, :2] - (crop.left, crop.top)
        # The finder counts the first pixel's centre as 0.5, the released code as 0.
        return Picture(pixels, landmarks * (CROP_PIXELS / crop.size) - 0.5, crop)

    def estimate(self, pixels: Image, square: FaceSquare) -> Estimate:
        """One DECA pass over ``square`` of a 256 x 256 picture."""
        (found,) = self.deca(square.cut(pixels)[None])
        codes = split_codes(found[0])
        pose = self.full_pose(codes["pose"])
        return Estimate(Coefficients(codes["shape"], codes["exp"], pose), codes["cam"])

    def full_pose(self, pose: NDArray[np.floating]) -> Array:
        """DECA's six (global and jaw rotation) -> (15,); neck and eyes as FLAME rests."""
        full = self.rest_pose.copy()
        full[:3], full[6:9] = pose[:3], pose[3:]
        return full


def _in_image(camera: Camera, crop: Crop) -> Camera:
    """The inverse of :meth:`Camera.in_crop`."""
    return Camera(
        camera.scale * crop.size / 2,
        camera.tx + (2 * crop.left / crop.size + 1) / camera.scale,
        camera.ty - (2 * crop.top / crop.size + 1) / camera.scale,
    )
