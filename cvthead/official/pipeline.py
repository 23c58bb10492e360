"""The official preset: encode(image) -> avatar once, render(avatar, controls) -> frame.

The released code computes everything anew for every frame. Here encoding runs parsing, hair
model, DECA, image encoder and transformer once; a frame by coefficients costs head, splat and
U-Net, a driving frame one DECA pass more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import CROP_PIXELS, Camera
from cvthead.coefficients import Coefficients
from cvthead.controls import Controls, resolve
from cvthead.errors import ModelChangedError
from cvthead.frame import Frame
from cvthead.head.arkit import ArkitMap
from cvthead.head.model import HeadModel
from cvthead.official.arkit import fit_arkit
from cvthead.official.avatar import OfficialAvatar
from cvthead.official.background import without_person
from cvthead.official.crop import FaceSquare
from cvthead.official.manifest import PRESET, default_folder
from cvthead.official.networks import OfficialNetworks, Precision, foreground, picture_array
from cvthead.official.painted import Painted
from cvthead.official.projection import project
from cvthead.official.splat import splat
from cvthead.official.tracker import OfficialTracker, Picture
from cvthead.runtime.sessions import CPU
from cvthead.tracking.tracker import TrackedFace, Tracker

Array = NDArray[np.float32]
Image = NDArray[np.uint8]


class Driven(NamedTuple):
    """A frame to render, as a driving picture asks for it; unpacks into the arguments of
    :meth:`OfficialPipeline.render_coefficients`.

    Attributes:
        coefficients: the driver's expression and pose on the avatar's shape.
        camera: in the 256 x 256 picture's normalised coordinates.
        square: whose unit the depth is in.
    """

    coefficients: Coefficients
    camera: Camera
    square: FaceSquare


@dataclass(frozen=True, eq=False)
class OfficialPipeline:
    """The imported model. Immutable; safe to share between threads."""

    networks: OfficialNetworks
    head: HeadModel
    arkit: ArkitMap
    tracker: OfficialTracker

    @classmethod
    def load(
        cls,
        folder: Path | None = None,
        *,
        precision: Precision = "int8",
        threads: int | None = None,
        providers: Sequence[str] = CPU,
        encode_niceness: int = 0,
    ) -> OfficialPipeline:
        """Load an imported model.

        Args:
            folder: of the import; None takes :func:`default_folder`.
            precision: "int8" serves the 8-bit U-Net and image encoder where the import found
                them close enough to float; "float32" never does.
            threads: of each network; None takes the machine's cores.
            providers: of the networks, see cvthead.runtime.sessions; the open tracker's run on
                the CPU.
            encode_niceness: as cvthead.preset.load_preset has it.

        Raises:
            AssetError: nothing was imported there, it is damaged, or onnxruntime lacks a provider.
        """
        folder = folder or default_folder()
        networks = OfficialNetworks.load(
            folder,
            precision=precision,
            threads=threads,
            providers=providers,
            encode_niceness=encode_niceness,
        )
        finder, flame = Tracker.load(), networks.flame
        head = flame.head()
        arkit = fit_arkit(flame, finder.head, ArkitMap.load())
        tracker = OfficialTracker(head, finder, networks.deca, flame.rest_pose)
        return cls(networks, head, arkit, tracker)

    @property
    def preset(self) -> str:
        return PRESET

    @property
    def fingerprint(self) -> str:
        """Of the imported weights; an avatar made with others is refused."""
        return self.networks.manifest.fingerprint

    def encode(
        self,
        image: Image,
        *,
        face: int | None = None,
        only_one: bool = False,
        deform: bool = True,
    ) -> OfficialAvatar:
        """Turn a portrait into an avatar.

        The picture is cut to a square around the head, for the released model was trained on
        such crops; :meth:`encode_picture` takes one as it is.

        Args:
            image: (H, W, 3) uint8 RGB.
            face, only_one: as :meth:`cvthead.pipeline.Pipeline.encode`.
            deform: False leaves out hair and shoulders.

        Raises:
            ImageError, FaceError: as :meth:`cvthead.tracking.tracker.Tracker.track`.
        """
        picture = self.tracker.picture(image, face=face, only_one=only_one)
        return self.encode_picture(picture, deform=deform)

    def encode_picture(self, picture: Picture, *, deform: bool = True) -> OfficialAvatar:
        """Turn a 256 x 256 picture into an avatar, as the released code does.

        Args:
            picture: with the whole head in view.
            deform: False leaves out hair and shoulders; a network that was retrained without them
                has none.
        """
        deform = deform and self.networks.manifest.deformation
        image, square = picture_array(picture.pixels), picture.square
        mask = self.mask(image)
        estimate = self.tracker.estimate(picture.pixels, square)
        offsets = self.offsets(image) if deform else np.zeros_like(self.head.template)
        camera = square.camera(estimate.cam)
        points = project(self.head, estimate.coefficients, camera, offsets, square)
        return OfficialAvatar(
            self.describe(image, mask, points),
            offsets,
            estimate.coefficients,
            camera,
            square,
            picture.crop,
            without_person(picture.pixels, mask[0, 0] > 0),
            self.fingerprint,
        )

    def mask(self, image: Array) -> Array:
        """(1, 3, 256, 256) RGB in [-1, 1] -> (1, 1, 256, 256), 1 where the person is."""
        (logits,) = self.networks.parsing(image)
        return foreground(logits)

    def offsets(self, image: Array) -> Array:
        """(1, 3, 256, 256) RGB in [-1, 1] -> (5023, 3) hair and shoulders in metres."""
        _, offsets = self.networks.hair(image)
        return np.asarray(offsets[0])

    def hair(self, image: Array) -> Array:
        """(1, 3, 256, 256) RGB in [-1, 1] -> (60,) coefficients of :meth:`offsets`."""
        coefficients, _ = self.networks.hair(image)
        return np.asarray(coefficients[0])

    def describe(self, image: Array, mask: Array, points: Array) -> Array:
        """(5023, 32) vertex descriptors (paper section 3.3).

        Args:
            image: (1, 3, 256, 256) RGB in [-1, 1].
            mask: (1, 1, 256, 256).
            points: (5023, 3) the portrait's own projections.
        """
        source = np.concatenate([image, mask], axis=1)
        (descriptors,) = self.networks.describe(source, points[None])
        return np.asarray(descriptors[0])

    def drive(
        self,
        avatar: OfficialAvatar,
        image: Image,
        *,
        cross_identity: bool = True,
        previous: TrackedFace | None = None,
    ) -> Driven:
        """What a driving picture makes the avatar do: one DECA pass.

        Args:
            avatar: whose shape is kept.
            image: (H, W, 3) uint8 RGB.
            cross_identity: as :meth:`drive_picture`.
            previous: the same face in the driving frame before, as ``tracker.finder`` found it.

        Raises:
            ImageError, FaceError: as :meth:`cvthead.tracking.tracker.Tracker.track`.
        """
        picture = self.tracker.picture(image, previous=previous)
        return self.drive_picture(avatar, picture, cross_identity=cross_identity)

    def drive_picture(
        self, avatar: OfficialAvatar, picture: Picture, *, cross_identity: bool = True
    ) -> Driven:
        """As :meth:`drive`, of a 256 x 256 picture.

        Args:
            avatar: whose shape is kept.
            picture: of the driver.
            cross_identity: True places the driver's DECA camera in the avatar's face square, so
                that the head stays where the portrait has it; False places the head where the
                driving picture has it (the released code's ``is_cross_id``).
        """
        square = picture.square
        driver = self.tracker.estimate(picture.pixels, square)
        coefficients = replace(driver.coefficients, shape=avatar.coefficients.shape)
        placed = avatar.square if cross_identity else square
        return Driven(coefficients, placed.camera(driver.cam), placed)

    def render(self, avatar: OfficialAvatar, controls: Controls | None = None) -> Frame:
        """Render the avatar as the controls ask; absent ones keep the portrait's values.

        Expression goes into FLAME's expression. (The released code's demo writes it into shape.)

        Raises:
            ModelChangedError: the avatar was made with other weights.
            CoefficientsError: an unknown ARKit name or a value out of range.
        """
        coefficients, camera = resolve(
            avatar.coefficients, avatar.camera, controls or Controls(), self.arkit
        )
        return self.render_coefficients(avatar, coefficients, camera)

    def render_coefficients(
        self,
        avatar: OfficialAvatar,
        coefficients: Coefficients,
        camera: Camera,
        square: FaceSquare | None = None,
    ) -> Frame:
        """Render full coefficients seen by a normalised camera.

        Args:
            avatar: what to render.
            coefficients: of FLAME.
            camera: in the 256 x 256 picture's normalised coordinates.
            square: whose unit the depth is in (see :class:`Driven`); None takes the avatar's.

        Raises:
            ModelChangedError: as :meth:`render`.
        """
        return self.paint(avatar, self.pose(avatar, coefficients, camera, square)).frame()

    def paint_many(self, frames: Sequence[tuple[OfficialAvatar, Array]]) -> list[Frame]:
        """Splat and U-Net of avatars with the points of :meth:`pose`.

        One after the other: a batch is not faster on a CPU, and a picture must not depend on
        what is rendered beside it.
        """
        return [self.paint(avatar, points).frame() for avatar, points in frames]

    def white(
        self,
        avatar: OfficialAvatar,
        coefficients: Coefficients,
        camera: Camera,
        square: FaceSquare | None = None,
        *,
        threshold: float | None = None,
    ) -> Image:
        """(256, 256, 3) the released code's own output: over white, truncated to uint8.

        Args:
            avatar, coefficients, camera, square: as :meth:`render_coefficients`.
            threshold: None blends by the mask; HARD_MASK cuts it as the released evaluation does.
        """
        painted = self.paint(avatar, self.pose(avatar, coefficients, camera, square))
        return painted.over_white(threshold)

    def pose(
        self,
        avatar: OfficialAvatar,
        coefficients: Coefficients,
        camera: Camera,
        square: FaceSquare | None = None,
    ) -> Array:
        """Driven vertex projections (5023, 3): head model, skinning, hair, camera.

        Raises:
            ModelChangedError: as :meth:`render`.
        """
        if avatar.fingerprint != self.fingerprint:
            raise ModelChangedError(
                f"the avatar was made with weights {avatar.fingerprint}, "
                f"this model has {self.fingerprint}",
                hint="encode the portrait again",
            )
        placed = square or avatar.square
        return project(self.head, coefficients, camera, avatar.offsets, placed)

    def paint(self, avatar: OfficialAvatar, points: Array) -> Painted:
        """Splat and U-Net (paper section 3.4) of the points of :meth:`pose`."""
        (raw,) = self.networks.unet(self.splat(avatar, points))
        return Painted(raw[0])

    def splat(self, avatar: OfficialAvatar, points: Array) -> Array:
        """(1, 256, 256, channels) what the U-Net reads."""
        channels = self.networks.unet.channels
        return splat(points, avatar.descriptors, CROP_PIXELS, channels)[None]

    def background(self, avatar: OfficialAvatar) -> Image:
        """(256, 256, 3) uint8 RGB: the portrait's crop with the person painted away."""
        return avatar.background
