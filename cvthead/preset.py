"""What both presets can do: the interface that command line, service and evaluation use.

:class:`cvthead.pipeline.Pipeline` and :class:`cvthead.official.pipeline.OfficialPipeline` both fit
:class:`Preset`; nothing below needs to know which of them it has::

    preset = load_preset("official")                           # or "open"
    avatar = preset.encode(portrait)                           # once per source
    face = preset.tracker.track(driving_picture)               # official: one DECA pass
    pose = drive(preset.head, avatar, face)                    # cvthead.driving
    frame = preset.render_coefficients(avatar, *pose)          # head model, splat, U-Net

Coefficients have the same lengths in both (100 shape, 50 expression, five joints), but mean the
preset's own head: those of one preset must not be rendered with the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from cvthead.avatar import Avatar
from cvthead.camera import Camera, Crop
from cvthead.coefficients import Array, Coefficients
from cvthead.controls import Controls
from cvthead.driving import Driven
from cvthead.frame import Frame
from cvthead.head.arkit import ArkitMap
from cvthead.head.model import HeadModel
from cvthead.official.avatar import OfficialAvatar, is_official
from cvthead.official.pipeline import OfficialPipeline
from cvthead.pipeline import Pipeline
from cvthead.runtime.sessions import CPU
from cvthead.tracking.networks import Networks
from cvthead.tracking.tracker import TrackedFace

PRESETS = ("open", "official")

AvatarT = TypeVar("AvatarT")


class AnyAvatar(Driven, Protocol):
    """The part of an avatar that does not depend on the preset."""

    @property
    def crop(self) -> Crop: ...
    @property
    def fingerprint(self) -> str: ...
    def to_bytes(self) -> bytes: ...
    def save(self, path: Path | str) -> None: ...


class FaceTracker(Protocol):
    """Gives driving faces in the preset's own coefficients."""

    @property
    def head(self) -> HeadModel: ...
    @property
    def networks(self) -> Networks: ...
    def track(
        self,
        image: NDArray[np.uint8],
        *,
        face: int | None = None,
        only_one: bool = False,
        shape: Array | None = None,
        previous: TrackedFace | None = None,
    ) -> TrackedFace: ...


class Preset(Protocol[AvatarT]):
    """The loaded models of a preset, without what only one of them has."""

    @property
    def head(self) -> HeadModel: ...
    @property
    def arkit(self) -> ArkitMap: ...
    @property
    def tracker(self) -> FaceTracker: ...
    @property
    def preset(self) -> str: ...
    @property
    def fingerprint(self) -> str: ...
    def encode(
        self,
        image: NDArray[np.uint8],
        *,
        face: int | None = None,
        only_one: bool = False,
        deform: bool = True,
    ) -> AvatarT: ...
    def render(self, avatar: AvatarT, controls: Controls | None = None) -> Frame: ...
    def render_coefficients(
        self, avatar: AvatarT, coefficients: Coefficients, camera: Camera
    ) -> Frame: ...
    def pose(self, avatar: AvatarT, coefficients: Coefficients, camera: Camera) -> Array: ...
    def paint_many(self, frames: Sequence[tuple[AvatarT, Array]]) -> list[Frame]: ...
    def background(self, avatar: AvatarT) -> NDArray[np.uint8]: ...


def load_preset(
    name: str,
    *,
    model: Path | None = None,
    threads: int | None = None,
    providers: Sequence[str] = CPU,
    encode_niceness: int = 0,
) -> Preset[Any]:
    """The models of a preset.

    Args:
        name: one of PRESETS.
        model: folder of another model than the packaged one; for "official" of another import
            than the default one.
        threads: of the networks; None takes the machine's cores.
        providers: of the networks, see cvthead.runtime.sessions; the face tracker's run on the CPU.
        encode_niceness: lowers the priority of the threads that only encoding needs (Linux).

    Raises:
        AssetError: an unknown preset or provider, or a missing or altered file; for "official":
            nothing was imported.
    """
    if name != "official":
        return Pipeline.load(
            name,
            model=model,
            threads=threads,
            providers=providers,
            encode_niceness=encode_niceness,
        )
    return OfficialPipeline.load(
        model, threads=threads, providers=providers, encode_niceness=encode_niceness
    )


def load_avatar(path: Path) -> Avatar | OfficialAvatar:
    """An avatar file of either preset.

    Raises:
        AvatarFileError: as Avatar.load.
    """
    return OfficialAvatar.load(path) if is_official(path) else Avatar.load(path)
