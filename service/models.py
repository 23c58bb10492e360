"""``GET /v1/models``: what is loaded, what it takes, under which licences."""

from __future__ import annotations

from importlib.metadata import version
from typing import Self

from fastapi import APIRouter
from pydantic import BaseModel, Field

from cvthead.camera import CROP_PIXELS
from cvthead.coefficients import EXPRESSION_SIZE, JOINTS, SHAPE_SIZE
from cvthead.head.arkit import ARKIT_NAMES
from cvthead.official.manifest import HEAD_PART, LICENCES, WEIGHTS_PART
from service.state import ServiceDep

router = APIRouter()


class Licences(BaseModel):
    """SPDX identifiers where there is one; NOTICE and docs/official.md have the sources."""

    code: str = Field(default="Apache-2.0", description="Of the software.", examples=["Apache-2.0"])
    weights: str = Field(
        default="Apache-2.0", description="Of the trained weights.", examples=["Apache-2.0"]
    )
    head: str = Field(
        default="CC0-1.0",
        description="Of the head model (MakeHuman, or FLAME).",
        examples=["CC0-1.0"],
    )
    networks: str = Field(
        default="Apache-2.0",
        description="Of the face networks (MediaPipe).",
        examples=["Apache-2.0"],
    )
    imported: dict[str, str] = Field(
        default={},
        description="Of the parts that the official preset was imported from.",
        examples=[{licence.part: licence.licence for licence in LICENCES}, {}],
    )

    @classmethod
    def of(cls, preset: str) -> Self:
        """
        Args:
            preset: that is loaded.
        """
        if preset != "official":
            return cls()
        imported = {licence.part: licence.licence for licence in LICENCES}
        return cls(weights=imported[WEIGHTS_PART], head=imported[HEAD_PART], imported=imported)


class ModelInfo(BaseModel):
    """A loaded preset."""

    preset: str = Field(description="Name of the preset.", examples=["open"])
    fingerprint: str = Field(
        description="Of the trained weights; avatars of others answer 409 `model_changed`.",
        examples=["0123456789abcdef"],
    )
    version: str = Field(description="Of the software.", examples=["0.1.0"])
    frame_size: int = Field(
        description="Side of a frame as it is rendered, in pixels.", ge=1, examples=[CROP_PIXELS]
    )
    shape: int = Field(description="Number of shape coefficients.", ge=1, examples=[SHAPE_SIZE])
    expression: int = Field(
        description="Number of expression coefficients.", ge=1, examples=[EXPRESSION_SIZE]
    )
    pose: list[str] = Field(
        description="Joints; each is an axis-angle of 3 numbers, radians.",
        min_length=1,
        examples=[list(JOINTS)],
    )
    arkit: list[str] = Field(
        description="Blendshape names that `arkit` takes, each 0 to 1.",
        min_length=1,
        examples=[list(ARKIT_NAMES)],
    )
    licences: Licences


class Models(BaseModel):
    """The loaded presets."""

    items: list[ModelInfo]


@router.get("/v1/models", tags=["operation"], summary="What is loaded")
async def models(service: ServiceDep) -> Models:
    pipeline = service.pipeline
    info = ModelInfo(
        preset=pipeline.preset,
        fingerprint=pipeline.fingerprint,
        version=version("cvthead"),
        frame_size=CROP_PIXELS,
        shape=SHAPE_SIZE,
        expression=EXPRESSION_SIZE,
        pose=list(JOINTS),
        arkit=list(ARKIT_NAMES),
        licences=Licences.of(pipeline.preset),
    )
    return Models(items=[info])
