"""What requests may say: every field with its unit, range and an example."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from cvthead.camera import Camera
from cvthead.coefficients import EXPRESSION_SIZE, JOINTS, SHAPE_SIZE
from cvthead.controls import FIELDS, Controls, Mode
from cvthead.errors import CoefficientsError
from cvthead.head.arkit import ARKIT_NAMES
from cvthead.images import ImageFormat
from cvthead.preset import AnyAvatar
from service.problems import Problem

SHAPE_LIMIT, EXPRESSION_LIMIT = 20.0, 50.0  # standard deviations, as cvthead.coefficients has them
ANGLE_LIMIT = 6.28
MAX_FRAMES = 1000

STRICT = ConfigDict(extra="forbid", frozen=True)
Finite = Field(strict=True, allow_inf_nan=False)
Angle = Annotated[float, Finite, Field(ge=-ANGLE_LIMIT, le=ANGLE_LIMIT)]
# fail_fast: a long list of wrong numbers is one error, not thousands.
Rotation = Annotated[list[Angle], Field(min_length=3, max_length=3, fail_fast=True)]
Shape = Annotated[
    list[Annotated[float, Finite, Field(ge=-SHAPE_LIMIT, le=SHAPE_LIMIT)]],
    Field(min_length=SHAPE_SIZE, max_length=SHAPE_SIZE, fail_fast=True),
]
Expression = Annotated[
    list[Annotated[float, Finite, Field(ge=-EXPRESSION_LIMIT, le=EXPRESSION_LIMIT)]],
    Field(min_length=EXPRESSION_SIZE, max_length=EXPRESSION_SIZE, fail_fast=True),
]
ArkitName = Literal[ARKIT_NAMES]  # type: ignore[valid-type]
Weight = Annotated[float, Finite, Field(ge=0, le=1)]

Background = Annotated[str, Field(pattern=r"^(transparent|source|white|#[0-9a-fA-F]{6})$")]
Size = Annotated[
    int,
    Field(
        ge=16,
        le=1024,
        description="Side of the square picture in pixels. 256 is native; others are resampled.",
        examples=[512],
    ),
]
Quality = Annotated[
    int, Field(ge=1, le=100, description="Of JPEG and WebP; PNG is lossless.", examples=[85])
]
CameraChoice = Annotated[
    Literal["source", "driver"],
    Field(
        description="`source` keeps the portrait's camera; with `driver` the picture follows "
        "place and size of the driver's head."
    ),
]
Face = Annotated[
    int | None,
    Field(ge=0, le=99, description="Which face, 0 is the largest.", examples=[0]),
]


class PictureOptions(BaseModel):
    """The picture that is made of a frame."""

    model_config = STRICT

    size: Size = 256
    background: Background | None = Field(
        default=None,
        description="Behind the head: `transparent` (PNG and WebP), `source` (the portrait's own, "
        "the person painted away), `white` or `#rrggbb`. Default: transparent, for JPEG white.",
        examples=["#2b2b33"],
    )
    quality: Quality = 90


class BatchPictureOptions(PictureOptions):
    """The pictures that are made of the frames."""

    format: ImageFormat = Field(
        default="png", description="Of the frames in multipart and zip.", examples=["jpeg"]
    )


class PoseControls(BaseModel):
    """Rotations as axis-angle in radians. +x is the subject's left, +y up, +z out of the face: a
    positive `global` y turns the head to its left, a positive `jaw` x opens the mouth."""

    model_config = STRICT

    global_: Rotation | None = Field(
        None, alias="global", description="The whole head.", examples=[[0, 0.3, 0]]
    )
    neck: Rotation | None = Field(None, description="The head on the neck.", examples=[[0.1, 0, 0]])
    jaw: Rotation | None = Field(None, description="The jaw.", examples=[[0.25, 0, 0]])
    left_eye: Rotation | None = Field(
        None, description="The subject's left eye.", examples=[[0, 0.2, 0]]
    )
    right_eye: Rotation | None = Field(
        None, description="The subject's right eye.", examples=[[0, 0.2, 0]]
    )

    def rotations(self) -> dict[str, list[float]]:
        """Those that were given, by their names in Controls."""
        given = {FIELDS[j]: getattr(self, "global_" if j == "global" else j) for j in JOINTS}
        return {name: value for name, value in given.items() if value is not None}


class CameraControls(BaseModel):
    """Weak perspective in the picture's coordinates, which run from -1 to 1 over its edges:
    `x = scale (X + tx)`, `y = -scale (Y + ty)`. A missing value keeps the portrait's."""

    model_config = STRICT

    scale: float | None = Field(
        None,
        strict=True,
        allow_inf_nan=False,
        ge=0.01,
        le=1000,
        description="Picture units per metre; larger is nearer.",
        examples=[5.6],
    )
    tx: float | None = Field(
        None,
        strict=True,
        allow_inf_nan=False,
        ge=-10,
        le=10,
        description="Metres to the right.",
        examples=[0.01],
    )
    ty: float | None = Field(
        None,
        strict=True,
        allow_inf_nan=False,
        ge=-10,
        le=10,
        description="Metres up.",
        examples=[-0.02],
    )


class FrameControls(BaseModel):
    """One frame. What is missing keeps the portrait's value; 0 means zero."""

    model_config = STRICT | ConfigDict(
        json_schema_extra={
            "examples": [{"arkit": {"jawOpen": 0.4}, "pose": {"global": [0, 0.2, 0]}}, {}]
        }
    )

    shape: Shape | None = Field(
        None,
        description="Identity: 100 coefficients in standard deviations.",
        examples=[[0.5] + [0.0] * 99],
    )
    expression: Expression | None = Field(
        None,
        description="Expression: 50 coefficients in standard deviations.",
        examples=[[1.5] + [0.0] * 49],
    )
    pose: PoseControls | None = None
    camera: CameraControls | None = None
    arkit: dict[ArkitName, Weight] | None = Field(
        None,
        description="ARKit blendshapes, 0 to 1. Adds to `expression`, and moves jaw and eyes that "
        "`pose` does not give. In absolute mode it starts from the neutral expression.",
        examples=[{"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8}],
    )
    mode: Mode = Field(
        "absolute",
        description="`absolute` replaces the portrait's values, `relative` adds to them.",
        examples=["relative"],
    )

    def controls(self, avatar: AnyAvatar) -> Controls:
        """As the core takes them.

        Raises:
            CoefficientsError: out of the core's range.
        """
        camera = None
        if self.camera is not None:
            own = avatar.camera
            given = self.camera.model_dump(exclude_none=True)
            camera = Camera(**{"scale": own.scale, "tx": own.tx, "ty": own.ty} | given)
        return Controls(
            shape=self.shape,
            expression=self.expression,
            arkit=self.arkit,
            camera=camera,
            mode=self.mode,
            **({} if self.pose is None else self.pose.rotations()),
        )


class RenderRequest(FrameControls):
    """One picture. `{}` is the portrait itself."""

    output: PictureOptions = PictureOptions()


class BatchRequest(BaseModel):
    """Many pictures of one avatar."""

    model_config = STRICT

    frames: list[FrameControls] = Field(
        fail_fast=True,
        min_length=1,
        max_length=MAX_FRAMES,
        description="In the order of the result.",
        examples=[[{"arkit": {"jawOpen": 0.1}}, {"arkit": {"jawOpen": 0.5}}]],
    )
    fps: float = Field(
        25,
        strict=True,
        allow_inf_nan=False,
        ge=1,
        le=120,
        description="Frames per second of the video.",
        examples=[25],
    )
    output: BatchPictureOptions = BatchPictureOptions()


class PortraitOptions(BaseModel):
    """How a portrait is taken. Each can be a query parameter or a multipart field."""

    model_config = STRICT

    face: Face = Field(
        None,
        description="Which face, 0 is the largest. Without it the picture must show exactly one.",
    )
    lifetime: float | None = Field(
        None,
        ge=1,
        allow_inf_nan=False,
        description="Seconds until the avatar expires. Default and maximum are settings.",
        examples=[3600],
    )
    consent: bool = Field(
        False,
        description="You state that the person shown agreed. Required as soon as keys are set.",
        examples=[True],
    )


class DriveOptions(PictureOptions):
    """How a driving frame moves the avatar. Query parameter or multipart field."""

    relative: bool | None = Field(
        None,
        description="Add the motion since the `reference` frame to the portrait's own expression "
        "and pose, instead of copying the driver's. Default: true with a reference.",
        examples=[True],
    )
    camera: CameraChoice = "source"


class TrackOptions(BaseModel):
    """What is measured. Query parameter or multipart field."""

    model_config = STRICT

    face: Face = Field(None, description="Which face; the largest (0) by default.")
    blendshapes: bool = Field(True, description="Also measure the ARKit blendshapes.")


def invalid(where: str, pointer: str, message: str) -> Problem:
    """``invalid_request`` for one field, in the form that validation errors have."""
    error = {"in": where, "pointer": pointer, "message": message}
    return Problem("invalid_request", f"{where} {pointer}: {message}", errors=[error])


def checked_controls(frame: FrameControls, avatar: AnyAvatar, pointer: str = "") -> Controls:
    """``frame.controls``, with the frame's place in the message of an error."""
    try:
        return frame.controls(avatar)
    except CoefficientsError as error:
        if not pointer:
            raise
        raise CoefficientsError(f"{pointer}: {error}", hint=error.hint) from error
