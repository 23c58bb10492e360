"""Driver's motion on the avatar's body."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cvthead.camera import Camera
from cvthead.coefficients import Coefficients
from cvthead.driving import Portrait, at_neck, drive
from cvthead.head.model import HeadModel, Region
from cvthead.tracking.tracker import TrackedFace

CAMERA = Camera(5.5, 0.01, 0.02)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.load()


def turn(rotation: object) -> np.ndarray:
    return np.asarray(cv2.Rodrigues(np.asarray(rotation, np.float64))[0])


@pytest.mark.parametrize("body", [(0, 0, 0), (0.05, -0.3, 0.02)])
def test_the_face_stays_and_the_shoulders_stand(
    head: HeadModel, body: tuple[float, float, float]
) -> None:
    source = Coefficients.zeros().with_joints({"global": body})
    wanted = Coefficients.zeros().with_joints(
        {"global": (0.1, 0.4, 0.05), "neck": (0, 0.1, 0), "jaw": (0.2, 0, 0)}
    )
    turned, camera = at_neck(head, source, wanted, CAMERA)
    asked = CAMERA.project(head.vertices(wanted))
    given = camera.project(head.vertices(turned))
    face, shoulders = (head.region == r for r in (Region.FACE, Region.SHOULDERS))
    # Millimetres: 5.5 normalised units are a metre.
    assert np.abs(asked - given)[face, :2].mean() / 5.5e-3 < 0.2
    still = camera.project(head.vertices(source))
    assert np.abs(given - still)[shoulders].mean() / 5.5e-3 < 8
    assert np.abs(asked - still)[shoulders].mean() / 5.5e-3 > 20
    assert np.array_equal(turned.joint("global"), source.joint("global"))
    assert np.allclose(
        turn(turned.joint("global")) @ turn(turned.joint("neck")),
        turn(wanted.joint("global")) @ turn(wanted.joint("neck")),
        atol=1e-6,
    )


def test_the_body_turns_along_in_the_official_preset(head: HeadModel) -> None:
    source = Coefficients.zeros()
    driver = source.with_joints({"global": (0, 0.4, 0)})
    face = TrackedFace(driver, CAMERA, np.zeros((478, 3), np.float32), 1.0, (0, 0, 1, 1), 1.0)
    for preset, joint in (("official", "global"), ("open", "neck")):
        avatar = Portrait(source, CAMERA, preset)
        coefficients, camera = drive(head, avatar, face)
        assert np.allclose(coefficients.joint(joint), (0, 0.4, 0), atol=1e-6)
        assert camera == CAMERA


def test_the_source_itself_is_not_moved(head: HeadModel) -> None:
    source = Coefficients.zeros().with_joints({"global": (0.1, 0.2, 0), "neck": (0, 0.05, 0.02)})
    turned, camera = at_neck(head, source, source, CAMERA)
    assert np.allclose(turned.pose, source.pose, atol=1e-6)
    assert (camera.tx, camera.ty) == pytest.approx((CAMERA.tx, CAMERA.ty), abs=1e-6)
