"""encode(image) -> Avatar once per upload; render(avatar, controls) -> Frame per request.

Encoding runs tracker, segmentation, deformation and the vertex-feature transformer. Rendering
runs the head model, the splat and the U-Net, and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.avatar import Avatar
from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.controls import Controls, resolve
from cvthead.deformation import DeformationModel
from cvthead.errors import AssetError, AvatarFileError, ModelChangedError
from cvthead.frame import Frame
from cvthead.head.arkit import ArkitMap
from cvthead.head.model import HeadModel
from cvthead.points import FAR_AWAY, PointLayout
from cvthead.runtime.model_folder import packaged
from cvthead.runtime.networks import Networks
from cvthead.runtime.place import Placed, place
from cvthead.runtime.sessions import CPU
from cvthead.source import (
    HeadCrop,
    Source,
    cut_head,
    driven_points,
    portrait_pixels,
    read_source,
)
from cvthead.tracking.tracker import Tracker

BACKGROUND_QUALITY = 90
# The person's edge is soft; inpainting from just outside it would smear hair into the background.
INPAINT_MARGIN = 9


@dataclass(frozen=True, eq=False)
class Pipeline:
    """The loaded models of a preset. Immutable; safe to share between threads."""

    head: HeadModel
    arkit: ArkitMap
    tracker: Tracker
    deformer: DeformationModel
    layout: PointLayout
    networks: Networks

    @classmethod
    def load(
        cls,
        preset: str = "open",
        *,
        model: Path | None = None,
        threads: int | None = None,
        providers: Sequence[str] = CPU,
        encode_niceness: int = 0,
    ) -> Pipeline:
        """Load head, tracker and trained networks.

        Args:
            preset: "open".
            model: folder of another model of the preset than the packaged one, as
                cvthead.training.export writes it.
            threads: of the trained networks; None takes the machine's cores, at most 4.
            providers: of the trained networks, see cvthead.runtime.sessions; the tracker's run
                on the CPU.
            encode_niceness: as cvthead.preset.load_preset has it.

        Raises:
            AssetError: an unknown preset or provider, or a missing or altered file.
        """
        if preset != "open":
            raise AssetError(f"unknown preset {preset!r}", hint="use the preset 'open'")
        networks = Networks.load(
            model or packaged(preset),
            threads=threads,
            providers=providers,
            encode_niceness=encode_niceness,
        )
        head = HeadModel.load()
        return cls(
            head,
            ArkitMap.load(),
            Tracker.load(head),
            DeformationModel.from_head(head),
            PointLayout.of(head),
            networks,
        )

    @property
    def preset(self) -> str:
        return self.networks.preset

    @property
    def fingerprint(self) -> str:
        """Of the trained weights; an avatar made with others is refused."""
        return self.networks.fingerprint

    def encode(
        self,
        image: NDArray[np.uint8],
        *,
        face: int | None = None,
        only_one: bool = False,
        deform: bool = True,
    ) -> Avatar:
        """Turn a portrait into an avatar.

        Args:
            image: (H, W, 3) uint8 RGB.
            face: which face, 0 = largest; None also takes the largest.
            only_one: refuse a portrait with several faces.
            deform: False skips hair and shoulders (the paper's ablation without deformation).

        Raises:
            ImageError: not an (H, W, 3) uint8 array.
            FaceError: no face, several, too small, turned away.
        """
        tracked = self.tracker.track(image, face=face, only_one=only_one)
        crop = cut_head(self.tracker, image, tracked)
        source = read_source(
            self.deformer, self.layout, crop, deform=deform, all_seen=self.networks.all_seen
        )
        used = self._used(source)
        return Avatar(
            self.describe(source),
            source.places(self.layout)[:used].astype(np.float16),
            source.drawn[:used],
            portrait_pixels(source.network_input),
            source.deformation,
            crop.coefficients,
            crop.camera,
            crop.crop,
            without_person(crop),
            self.preset,
            self.fingerprint,
        )

    def describe(self, source: Source) -> NDArray[np.uint8]:
        """(P, C) descriptor codes of a source, unused shell points left out."""
        return self.networks.describe(source, source.hidden(self.layout))[: self._used(source)]

    def _used(self, source: Source) -> int:
        return self.layout.surface + len(source.deformation.shell_anchor)

    def render(self, avatar: Avatar, controls: Controls | None = None) -> Frame:
        """Render the avatar as the controls ask; absent ones keep the portrait's values.

        Raises:
            ModelChangedError: the avatar was made with other trained weights.
            AvatarFileError: its arrays do not fit the head model.
            CoefficientsError: an unknown ARKit name or a value out of range.
        """
        coefficients, camera = resolve(
            avatar.coefficients, avatar.camera, controls or Controls(), self.arkit
        )
        return self.render_coefficients(avatar, coefficients, camera)

    def render_coefficients(
        self, avatar: Avatar, coefficients: Coefficients, camera: Camera
    ) -> Frame:
        """Render full coefficients seen by a normalised camera.

        Raises:
            ModelChangedError, AvatarFileError: as :meth:`render`.
        """
        return self.paint(avatar, self.pose(avatar, coefficients, camera))

    def pose(
        self, avatar: Avatar, coefficients: Coefficients, camera: Camera
    ) -> NDArray[np.float32]:
        """Driven point projections (P, 3): head model, skinning, camera. Points that the
        portrait cuts off are far away."""
        self._check(avatar)
        points = driven_points(self.head, self.layout, coefficients, avatar.deformation, camera)
        points = points[: len(avatar.descriptors)]
        points[~avatar.drawn] = FAR_AWAY
        return points

    def place(self, avatar: Avatar, points: NDArray[np.float32]) -> Placed:
        """Splat the descriptors and carry the portrait's pixels; see cvthead.runtime.place."""
        return place(
            self.layout,
            points,
            avatar.exact_places,
            avatar.owners,
            avatar.rim,
            avatar.descriptors,
            avatar.portrait,
            self.networks.splat_size,
        )

    def paint(self, avatar: Avatar, points: NDArray[np.float32]) -> Frame:
        """Splat, warp and U-Net (paper section 3.4)."""
        return self.paint_many([(avatar, points)])[0]

    def paint_many(self, frames: Sequence[tuple[Avatar, NDArray[np.float32]]]) -> list[Frame]:
        """:meth:`paint` of several frames, of the same or of different avatars, at once."""
        inputs = []
        for avatar, points in frames:
            self._check(avatar)
            inputs.append(self.place(avatar, points))
        painted = self.networks.paint(inputs)
        return [Frame.of_rgba(rgba) for rgba in painted]

    def _check(self, avatar: Avatar) -> None:
        """Refuse an avatar of other weights, or one whose arrays do not fit (a forged file)."""
        hint = "encode the portrait again"
        if avatar.fingerprint != self.fingerprint:
            raise ModelChangedError(
                f"the avatar was made with weights {avatar.fingerprint}, "
                f"this model has {self.fingerprint}",
                hint=hint,
            )
        points = self.layout.surface + len(avatar.deformation.shell_anchor)
        expected = {
            "descriptors": (points, self.networks.descriptor_size),
            "offsets": (self.layout.vertices, 3),
        }
        found = {
            "descriptors": avatar.descriptors.shape,
            "offsets": avatar.deformation.offsets.shape,
        }
        for name, shape in expected.items():
            if found[name] != shape:
                raise AvatarFileError(
                    f"the avatar's {name} have shape {found[name]}, expected {shape}", hint=hint
                )

    def background(self, avatar: Avatar) -> NDArray[np.uint8]:
        """(256, 256, 3) uint8 RGB: the portrait's crop with the person painted away."""
        image = cv2.imdecode(np.frombuffer(avatar.background, np.uint8), cv2.IMREAD_COLOR_RGB)
        assert image is not None, "avatar files are checked when they are loaded"
        return image.astype(np.uint8)


def without_person(crop: HeadCrop) -> bytes:
    """JPEG of the crop with the person inpainted from the background around it."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (INPAINT_MARGIN,) * 2)
    person = cv2.dilate((crop.mask > 0.1).astype(np.uint8), kernel)
    bgr = np.ascontiguousarray(crop.image[..., ::-1])
    # Telea at a quarter of the size: a smooth fill is wanted, and full size takes half a second.
    small = cv2.resize(bgr, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    hole = cv2.resize(person, (small.shape[1], small.shape[0]), interpolation=cv2.INTER_AREA)
    filled = cv2.inpaint(small, (hole > 0).astype(np.uint8), 3, cv2.INPAINT_TELEA)
    filled = cv2.resize(filled, (bgr.shape[1], bgr.shape[0]), interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(person.astype(np.float32), (0, 0), 3)[..., None]
    soft = np.maximum(soft, person[..., None])
    blended = (bgr * (1 - soft) + filled * soft).astype(np.uint8)
    done, data = cv2.imencode(".jpg", blended, [cv2.IMWRITE_JPEG_QUALITY, BACKGROUND_QUALITY])
    assert done
    return data.tobytes()
