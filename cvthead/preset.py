"""What both presets can do: the interface that the command line renders through."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from cvthead.camera import Camera
from cvthead.coefficients import Array, Coefficients
from cvthead.controls import Controls
from cvthead.driving import Driven
from cvthead.errors import AssetError
from cvthead.frame import Frame
from cvthead.head.arkit import ArkitMap
from cvthead.head.model import HeadModel
from cvthead.pipeline import Pipeline
from cvthead.tracking.tracker import TrackedFace

PRESETS = ("open", "official")

AvatarT = TypeVar("AvatarT")


class AnyAvatar(Driven, Protocol):
    """The part of an avatar that does not depend on the preset."""

    def save(self, path: Path | str) -> None: ...


class FaceTracker(Protocol):
    """Gives driving faces in the preset's own coefficients."""

    @property
    def head(self) -> HeadModel: ...
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
    """:class:`cvthead.pipeline.Pipeline` without what only the open preset has."""

    @property
    def head(self) -> HeadModel: ...
    @property
    def arkit(self) -> ArkitMap: ...
    @property
    def tracker(self) -> FaceTracker: ...
    @property
    def preset(self) -> str: ...
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
    def background(self, avatar: AvatarT) -> NDArray[np.uint8]: ...


def load_preset(name: str) -> Preset[Any]:
    """The models of a preset.

    Raises:
        AssetError: an unknown preset; for "official": nothing was imported, or PyTorch is not
            installed.
    """
    if name != "official":
        return Pipeline.load(name)
    try:
        # PyTorch takes seconds to load and is not installed everywhere.
        from cvthead.official.pipeline import OfficialPipeline
    except ImportError as error:
        raise AssetError(
            f"the official preset needs {error.name}",
            hint='install with pip install "cvthead[train]"',
        ) from error
    return OfficialPipeline.load()
