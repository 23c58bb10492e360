"""ARKit units in and out of coefficients."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.coefficients import Coefficients
from cvthead.errors import CoefficientsError
from cvthead.head.arkit import ARKIT_NAMES, ArkitMap
from cvthead.head.model import HeadModel, Region

UPPER_LIP, LOWER_LIP = 13, 14  # inner lip landmarks
UPPER_LID, LOWER_LID = 386, 374  # left eye
MOUTH_CORNER = 291  # left


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.load()


@pytest.fixture(scope="module")
def arkit() -> ArkitMap:
    return ArkitMap.load()


def landmarks(head: HeadModel, arkit: ArkitMap, **weights: float) -> NDArray[np.float32]:
    return head.landmarks(head.vertices(arkit.to_coefficients(weights)))


def test_there_are_apples_52_names() -> None:
    assert len(set(ARKIT_NAMES)) == 52
    left = {n.removesuffix("Left") for n in ARKIT_NAMES if n.endswith("Left")}
    assert left == {n.removesuffix("Right") for n in ARKIT_NAMES if n.endswith("Right")}


def test_nothing_is_neutral(head: HeadModel, arkit: ArkitMap) -> None:
    neutral = arkit.to_coefficients({})
    assert not neutral.expression.any()
    assert not neutral.pose.any()


def test_jaw_open_opens_the_mouth(head: HeadModel, arkit: ArkitMap) -> None:
    def gap(amount: float) -> float:
        points = landmarks(head, arkit, jawOpen=amount)
        return float(points[UPPER_LIP, 1] - points[LOWER_LIP, 1])

    assert gap(0.0) < 0.008
    assert gap(1.0) > 0.02
    assert gap(0.0) < gap(0.3) < gap(0.7) < gap(1.0)


def test_mouth_close_closes_the_open_jaw(head: HeadModel, arkit: ArkitMap) -> None:
    opened = landmarks(head, arkit, jawOpen=1.0)
    closed = landmarks(head, arkit, jawOpen=1.0, mouthClose=1.0)
    gaps = [p[UPPER_LIP, 1] - p[LOWER_LIP, 1] for p in (opened, closed)]
    assert gaps[1] < 0.4 * gaps[0]


def test_blink_closes_one_eye(head: HeadModel, arkit: ArkitMap) -> None:
    neutral, blink = landmarks(head, arkit), landmarks(head, arkit, eyeBlinkLeft=1.0)
    opening = [p[UPPER_LID, 1] - p[LOWER_LID, 1] for p in (neutral, blink)]
    assert opening[1] < 0.35 * opening[0]
    right = [159, 145]
    np.testing.assert_allclose(blink[right], neutral[right], atol=1e-4)


def test_smile_raises_the_mouth_corner_on_its_side(head: HeadModel, arkit: ArkitMap) -> None:
    moved = landmarks(head, arkit, mouthSmileLeft=1.0) - landmarks(head, arkit)
    assert moved[MOUTH_CORNER, 1] > 0.004
    assert np.linalg.norm(moved[61]) < 0.3 * np.linalg.norm(moved[MOUTH_CORNER])


@pytest.mark.parametrize(
    ("unit", "axis", "sign"),
    [
        ("eyeLookUpLeft", 1, 1),
        ("eyeLookDownLeft", 1, -1),
        ("eyeLookOutLeft", 0, 1),
        ("eyeLookInLeft", 0, -1),
        ("eyeLookOutRight", 0, -1),
        ("eyeLookInRight", 0, 1),
    ],
)
def test_eyes_turn(head: HeadModel, arkit: ArkitMap, unit: str, axis: int, sign: int) -> None:
    iris = 473 if unit.endswith("Left") else 468
    moved = landmarks(head, arkit, **{unit: 1.0}) - landmarks(head, arkit)
    assert sign * moved[iris, axis] > 0.0015
    assert np.linalg.norm(moved[941 - iris]) < 1e-5  # the other eye: 468 + 473 = 941


def test_tongue_out_moves_the_tongue_only(head: HeadModel, arkit: ArkitMap) -> None:
    vertices = head.vertices(arkit.to_coefficients({"tongueOut": 1.0}))
    moved = np.linalg.norm(vertices - head.template, axis=1)
    mouth = head.region == Region.MOUTH
    assert moved[mouth].max() > 0.01
    assert moved[~mouth].max() < 1e-4


def test_every_unit_has_an_effect_and_a_mirror_image(head: HeadModel, arkit: ArkitMap) -> None:
    sides = {"Left": "Right", "Right": "Left"}
    for name in ARKIT_NAMES:
        side = next((s for s in sides if name.endswith(s)), "")
        other = name.removesuffix(side) + sides.get(side, "")
        one = head.vertices(arkit.to_coefficients({name: 1.0}))
        two = head.vertices(arkit.to_coefficients({other: 1.0}))
        assert np.linalg.norm(one - head.template, axis=1).max() > 1e-3, name
        np.testing.assert_allclose(
            two, one[head.mirror] * np.array([-1, 1, 1]), atol=2e-5, err_msg=name
        )


@pytest.mark.parametrize("name", ARKIT_NAMES)
def test_every_unit_round_trips(arkit: ArkitMap, name: str) -> None:
    found = arkit.from_coefficients(arkit.to_coefficients({name: 0.6}))
    expected = dict.fromkeys(ARKIT_NAMES, 0.0) | {name: 0.6}
    assert found == pytest.approx(expected, abs=0.02)


def test_mixtures_come_back_as_the_same_face(head: HeadModel, arkit: ArkitMap) -> None:
    """Weights need not be unique (looking in and out at once), the face is."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        weights = dict(zip(ARKIT_NAMES, rng.exponential(0.2, 52).clip(0, 1), strict=True))
        made = arkit.to_coefficients(weights)
        again = arkit.to_coefficients(arkit.from_coefficients(made))
        np.testing.assert_allclose(head.vertices(again), head.vertices(made), atol=1e-4)


def test_inverse_stays_in_range_for_any_face(arkit: ArkitMap) -> None:
    rng = np.random.default_rng(1)
    shape, expression, pose = (rng.normal(size=n).astype(np.float32) for n in (100, 50, 15))
    wild = Coefficients(shape, 5 * expression, pose)
    assert all(0 <= w <= 1 for w in arkit.from_coefficients(wild).values())


@pytest.mark.parametrize("name", ["smile", "_neutral", "jawopen", "", "JawOpen"])
def test_unknown_names_are_refused(arkit: ArkitMap, name: str) -> None:
    with pytest.raises(CoefficientsError, match="unknown ARKit"):
        arkit.to_coefficients({name: 0.5})


@pytest.mark.parametrize("weight", [float("nan"), float("inf"), -0.1, 1.1, "much", None])
def test_bad_weights_are_refused(arkit: ArkitMap, weight: object) -> None:
    with pytest.raises(CoefficientsError, match="jawOpen"):
        arkit.to_coefficients({"jawOpen": weight})  # type: ignore[dict-item]
