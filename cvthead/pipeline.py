"""encode(image) -> Avatar once per upload; render(avatar, controls) -> Frame per request.

Encoding runs tracker, segmentation, deformation and the vertex-feature transformer. Rendering
runs the head model, the splat and the U-Net, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cvthead.avatar import Avatar
from cvthead.camera import CROP_PIXELS, Camera
from cvthead.coefficients import Coefficients
from cvthead.controls import Controls, resolve
from cvthead.deformation import MAX_SHELL_POINTS, DeformationModel
from cvthead.errors import AssetError, AvatarFileError, ModelChangedError
from cvthead.frame import Frame
from cvthead.head.arkit import ArkitMap
from cvthead.head.hierarchy import MeshHierarchy
from cvthead.head.model import HeadModel
from cvthead.model.config import OPEN
from cvthead.model.cvthead import CVTHead
from cvthead.model.pixel_aligned import PLACE_SIZE
from cvthead.points import PointLayout
from cvthead.source import (
    HeadCrop,
    Source,
    cut_head,
    driven_points,
    network_input,
    read_source,
)
from cvthead.tracking.tracker import Tracker
from cvthead.weights import load_into, packaged_weights

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
    model: CVTHead
    preset: str
    fingerprint: str

    @classmethod
    def load(cls, preset: str = "open", weights: Path | None = None) -> Pipeline:
        """Load head, tracker and trained weights.

        Args:
            preset: "open".
            weights: other weights of the same preset than the packaged ones.

        Raises:
            AssetError: an unknown preset, or a missing or altered file.
        """
        if preset != "open":
            raise AssetError(f"unknown preset {preset!r}", hint="use the preset 'open'")
        head = HeadModel.load()
        layout = PointLayout.of(head)
        model = CVTHead(OPEN, MeshHierarchy.load(), layout)
        mark = load_into(model, weights or packaged_weights(preset))
        model = model.eval().requires_grad_(False)
        model = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return cls(
            head,
            ArkitMap.load(),
            Tracker.load(head),
            DeformationModel.from_head(head),
            layout,
            model,
            preset,
            mark,
        )

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
        source = read_source(self.deformer, self.layout, crop, deform=deform)
        return Avatar(
            self.describe(source),
            portrait(crop),
            source.deformation,
            crop.coefficients,
            crop.camera,
            crop.crop,
            without_person(crop),
            self.preset,
            self.fingerprint,
        )

    @torch.inference_mode()
    def describe(self, source: Source) -> NDArray[np.float16]:
        """(P, C + 3) descriptors of a source, unused shell points left out."""
        shell = len(source.deformation.shell_anchor)
        anchor = np.zeros(MAX_SHELL_POINTS, np.int64)
        anchor[:shell] = source.deformation.shell_anchor
        out = self.model.describe(
            torch.from_numpy(source.network_input)[None],
            torch.from_numpy(source.points)[None],
            torch.from_numpy(source.visible.astype(np.float32))[None],
            torch.from_numpy(anchor)[None],
        )
        return out[0, : self.layout.surface + shell].numpy().astype(np.float16)

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
        """Driven point projections (P, 3): head model, skinning, camera."""
        self._check(avatar)
        points = driven_points(self.head, self.layout, coefficients, avatar.deformation, camera)
        return points[: len(avatar.descriptors)]

    @torch.inference_mode()
    def paint(self, avatar: Avatar, points: NDArray[np.float32]) -> Frame:
        """Splat and U-Net (paper section 3.4)."""
        self._check(avatar)
        rgb, logits = self.model.paint(
            torch.from_numpy(points)[None],
            torch.from_numpy(avatar.descriptors.astype(np.float32))[None],
            torch.from_numpy(avatar.portrait_input)[None],
            CROP_PIXELS,
        )
        colour = ((rgb[0] + 1) * 127.5).round().byte().permute(1, 2, 0).contiguous()
        alpha = (logits[0, 0].sigmoid() * 255).round().byte()
        return Frame(colour.numpy(), alpha.numpy())

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
            "descriptors": (points, self.model.config.descriptor_size + PLACE_SIZE),
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


def portrait(crop: HeadCrop) -> NDArray[np.uint8]:
    """(256, 256, 4) uint8 of the person alone, as :class:`Avatar` keeps it."""
    rgb, mask = network_input(crop.image, crop.mask)[:3], crop.mask[..., None] * 255
    image = np.concatenate([(rgb.transpose(1, 2, 0) + 1) * 127.5, mask], axis=-1)
    return np.asarray(np.rint(image), np.uint8)


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
