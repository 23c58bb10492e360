"""What answers say: every field with its unit and an example."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Self

from pydantic import BaseModel, Field

from cvthead.camera import Camera
from cvthead.coefficients import EXPRESSION_SIZE, JOINTS, SHAPE_SIZE, Array, Coefficients
from cvthead.preset import AnyAvatar
from cvthead.record import AvatarRecord
from cvthead.tracking.tracker import TrackedFace

EXAMPLE_ID = "5f2b8c0d9e4a47f1a6b3c2d1e0f98765"
EXAMPLE_CURSOR = f"1772366400.123456-{EXAMPLE_ID}"
VECTOR = [[0.0, 0.1, 0.0]]
BOX = [[171.2, 64.8, 296.1, 230.4]]

Rotation = Annotated[list[float], Field(min_length=3, max_length=3)]
FaceBox = Annotated[list[float], Field(min_length=4, max_length=4)]
Shape = Annotated[
    list[float],
    Field(
        min_length=SHAPE_SIZE,
        max_length=SHAPE_SIZE,
        description="Identity: 100 coefficients in standard deviations.",
        examples=[[0.5] + [0.0] * (SHAPE_SIZE - 1)],
    ),
]
Expression = Annotated[
    list[float],
    Field(
        min_length=EXPRESSION_SIZE,
        max_length=EXPRESSION_SIZE,
        description="Expression: 50 coefficients in standard deviations.",
        examples=[[1.5] + [0.0] * (EXPRESSION_SIZE - 1)],
    ),
]


class Pose(BaseModel):
    """Rotations as axis-angle in radians, as `PoseControls` has them."""

    global_: Rotation = Field(alias="global", description="Of the whole head.", examples=VECTOR)
    neck: Rotation = Field(description="Of the head on the neck.", examples=VECTOR)
    jaw: Rotation = Field(description="Of the jaw.", examples=VECTOR)
    left_eye: Rotation = Field(description="Of the subject's left eye.", examples=VECTOR)
    right_eye: Rotation = Field(description="Of the subject's right eye.", examples=VECTOR)

    @classmethod
    def of(cls, coefficients: Coefficients) -> Self:
        return cls.model_validate({j: listed(coefficients.joint(j)) for j in JOINTS})


class CameraInfo(BaseModel):
    """Weak perspective: `x = scale (X + tx)`, `y = -scale (Y + ty)`."""

    scale: float = Field(description="Image units per metre.", examples=[5.6])
    tx: float = Field(description="Metres to the right.", examples=[0.01])
    ty: float = Field(description="Metres up.", examples=[-0.02])

    @classmethod
    def of(cls, camera: Camera) -> Self:
        return cls(scale=camera.scale, tx=camera.tx, ty=camera.ty)


class SourceInfo(BaseModel):
    """Coefficients of the portrait: where `relative` starts and what missing values keep."""

    shape: Shape
    expression: Expression
    pose: Pose
    camera: CameraInfo = Field(description="In the picture's coordinates, -1 to 1.")


class Links(BaseModel):
    """Paths of what can be done with the avatar."""

    self: str = Field(description="The avatar.", examples=[f"/v1/avatars/{EXAMPLE_ID}"])
    render: str = Field(
        description="One picture from coefficients.", examples=[f"/v1/avatars/{EXAMPLE_ID}/render"]
    )
    drive: str = Field(
        description="One picture from a driving frame.",
        examples=[f"/v1/avatars/{EXAMPLE_ID}/drive"],
    )
    batch: str = Field(description="Many pictures.", examples=[f"/v1/avatars/{EXAMPLE_ID}/batch"])
    stream: str = Field(description="WebSocket.", examples=[f"/v1/avatars/{EXAMPLE_ID}/stream"])
    preview: str = Field(
        description="The portrait as it is rendered.",
        examples=[f"/v1/avatars/{EXAMPLE_ID}/preview"],
    )

    @classmethod
    def of(cls, path: str) -> Self:
        names = ("render", "drive", "batch", "stream", "preview")
        return cls.model_validate({"self": path} | {name: f"{path}/{name}" for name in names})


class AvatarSummary(BaseModel):
    """A stored avatar."""

    id: str = Field(
        description="Unguessable; whoever has it (and the key) can use the avatar.",
        examples=[EXAMPLE_ID],
    )
    created: datetime = Field(description="UTC.", examples=["2026-03-01T12:00:00Z"])
    expires: datetime | None = Field(
        description="UTC; then it answers 410. Null: never.", examples=["2026-03-08T12:00:00Z"]
    )
    bytes: int = Field(description="Size in the store.", ge=0, examples=[612345])
    preset: str = Field(description="Model that made it.", examples=["open"])
    fingerprint: str = Field(
        description="Of the trained weights; with others loaded it answers 409.",
        examples=["0123456789abcdef"],
    )
    face_box: FaceBox | None = Field(
        description="Left, top, right, bottom of the face in pixels of the portrait.",
        examples=BOX,
    )
    links: Links

    @classmethod
    def of(cls, record: AvatarRecord, path: str) -> Self:
        """
        Args:
            path: of the avatar.
        """
        return cls.model_validate(summary(record, path))


class AvatarInfo(AvatarSummary):
    """A stored avatar with the coefficients of its portrait."""

    source: SourceInfo

    @classmethod
    def about(cls, record: AvatarRecord, path: str, avatar: AnyAvatar) -> Self:
        coefficients = avatar.coefficients
        source = SourceInfo(
            shape=listed(coefficients.shape),
            expression=listed(coefficients.expression),
            pose=Pose.of(coefficients),
            camera=CameraInfo.of(avatar.camera),
        )
        return cls.model_validate(summary(record, path) | {"source": source})


class AvatarPage(BaseModel):
    """Avatars of the caller, newest first."""

    items: list[AvatarSummary] = Field(description="At most `limit`.")
    next: str | None = Field(
        description="`cursor` of the next page; null on the last.",
        max_length=100,
        examples=[EXAMPLE_CURSOR, None],
    )


class TrackAnswer(BaseModel):
    """The measured face. `expression` and `pose` can be sent to `render` and to a stream."""

    shape: Shape
    expression: Expression
    pose: Pose
    camera: CameraInfo = Field(description="In pixels of the picture.")
    arkit: dict[str, float] | None = Field(
        description="ARKit blendshapes, 0 to 1 (all but `tongueOut`), if asked for.",
        examples=[{"jawOpen": 0.31}],
    )
    box: FaceBox = Field(
        description="Left, top, right, bottom of the face in pixels.",
        examples=BOX,
    )
    yaw: float = Field(
        description="Degrees that the head is turned to its left; beyond 60 the fit is uncertain.",
        ge=-180,
        le=180,
        examples=[-4.2],
    )
    error: float = Field(
        description="Mean landmark error in percent of the outer-eye distance.",
        ge=0,
        examples=[2.4],
    )
    presence: float = Field(
        description="The network's belief that this is a face, 0.5 to 1.",
        ge=0.5,
        le=1,
        examples=[0.99],
    )

    @classmethod
    def of(cls, face: TrackedFace, arkit: dict[str, float] | None) -> Self:
        return cls(
            shape=listed(face.coefficients.shape),
            expression=listed(face.coefficients.expression),
            pose=Pose.of(face.coefficients),
            camera=CameraInfo.of(face.camera),
            arkit=arkit,
            box=[round(value, 2) for value in face.box],
            yaw=round(face.yaw, 2),
            error=round(float(face.error), 3),
            presence=round(float(face.presence), 4),
        )


def summary(record: AvatarRecord, path: str) -> dict[str, object]:
    """Fields of AvatarSummary."""
    return {
        "id": record.id,
        "created": _utc(record.created),
        "expires": None if record.expires is None else _utc(record.expires),
        "bytes": record.bytes,
        "preset": record.preset,
        "fingerprint": record.fingerprint,
        "face_box": record.box and [round(value, 2) for value in record.box],
        "links": Links.of(path),
    }


def listed(values: Array) -> list[float]:
    """Shortest decimals that give the same float32 again."""
    return [float(str(value)) for value in values]


def _utc(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)
