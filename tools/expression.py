"""ARKit face units turned into FLAME's parts: expression basis, jaw and eye joints, correctives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tools.identity import FLIP, similarity
from tools.makehuman import MakeHuman
from tools.topology import BaseHead, Part

Floats = NDArray[np.float64]
Units = Mapping[str, Floats]

EXPRESSION_SIZE = 50
POSE_FEATURES = 36
JAW, LEFT_EYE, RIGHT_EYE = 2, 3, 4
LIP_SPREAD = 0.3
# Identity targets that change the lips; expressions need a little of that freedom too.
_LIPS = (
    ("upperlip-height-incr", "upperlip-height-decr"),
    ("lowerlip-height-incr", "lowerlip-height-decr"),
    ("upperlip-volume-incr", "upperlip-volume-decr"),
    ("lowerlip-volume-incr", "lowerlip-volume-decr"),
    ("angles-up", "angles-down"),
    ("upperlip-middle-up", "upperlip-middle-down"),
    ("lowerlip-middle-up", "lowerlip-middle-down"),
    ("scale-horiz-incr", "scale-horiz-decr"),
)


def opposite(unit: str) -> str:
    """Name of the unit on the other side, or the same name."""
    if unit.endswith("Left"):
        return unit[:-4] + "Right"
    return unit[:-5] + "Left" if unit.endswith("Right") else unit


def read_units(data: MakeHuman, head: BaseHead, scale: float, names: tuple[str, ...]) -> Units:
    """Displacements (B, 3) in metres of every unit, mirror-consistent."""
    raw = {name: data.face_unit(name)[head.ids].astype(np.float64) * scale for name in names}
    return {n: (raw[n] + raw[opposite(n)][head.mirror] * FLIP) / 2 for n in names}


@dataclass(frozen=True)
class Jaw:
    """Joint that reproduces jawOpen: angle about x (radians), pivot (3,) in base metres,
    skinning weight (B,), and what skinning leaves over, (B, 3) in the rest pose."""

    angle: float
    pivot: Floats
    weight: Floats
    residual: Floats


def fit_jaw(base: Floats, part: NDArray[np.int64], opened: Floats) -> Jaw:
    """The lower teeth move rigidly; their rotation is the jaw's."""
    teeth = part == Part.LOWER_TEETH
    rotation, translation = _rigid(base[teeth], base[teeth] + opened[teeth])
    angle = float(np.arctan2(rotation[2, 1], rotation[1, 1]))
    rotation = _about_x(angle)
    pivot = np.zeros(3)
    pivot[1:] = np.linalg.solve((np.eye(3) - rotation)[1:, 1:], translation[1:])
    full = (base - pivot) @ (rotation - np.eye(3)).T
    weight = ((opened * full).sum(1) / ((full * full).sum(1) + 1e-9)).clip(0, 1)
    weight[np.linalg.norm(opened, axis=1) < 1e-5] = 0
    weight[teeth] = 1
    weight[np.isin(part, [Part.UPPER_TEETH, Part.LEFT_EYE, Part.RIGHT_EYE])] = 0
    blend = np.eye(3) + weight[:, None, None] * (rotation - np.eye(3))
    target = base + opened - weight[:, None] * (pivot - rotation @ pivot)
    residual = np.linalg.solve(blend, target[..., None])[..., 0] - base
    return Jaw(angle, pivot, weight, residual)


def fit_gaze(base: Floats, part: NDArray[np.int64], units: Units) -> dict[str, Floats]:
    """Axis-angle (3,) without roll of each eyeLook unit's eyeball."""
    gaze = {}
    for side, eye in (("Left", Part.LEFT_EYE), ("Right", Part.RIGHT_EYE)):
        ball = part == eye
        for direction in ("Up", "Down", "In", "Out"):
            unit = f"eyeLook{direction}{side}"
            rotation, _ = _rigid(base[ball], base[ball] + units[unit][ball])
            skew = rotation - rotation.T
            sine = np.array([skew[2, 1], skew[0, 2], 0.0]) / 2
            size = float(np.linalg.norm(sine))
            gaze[unit] = sine / size * np.arcsin(size)
    return gaze


def pose_correctives(
    jaw: Jaw, part: NDArray[np.int64], units: Units, gaze: Mapping[str, Floats]
) -> Floats:
    """(B, 3, 36) displacement for each entry of R - I of neck, jaw, left eye, right eye.

    The sine of a rotation about x stands in entries (2, 1) and, negated, (1, 2).
    """
    basis = np.zeros((len(part), 3, POSE_FEATURES))

    def follow_sine(joint: int, field: Floats) -> None:
        start = 9 * (joint - 1)
        basis[:, :, start + 7] += field / 2
        basis[:, :, start + 5] -= field / 2

    follow_sine(JAW, jaw.residual / np.sin(jaw.angle))
    for joint, side, eye in (
        (LEFT_EYE, "Left", Part.LEFT_EYE),
        (RIGHT_EYE, "Right", Part.RIGHT_EYE),
    ):
        up, down = (units[f"eyeLook{d}{side}"] * (part != eye)[:, None] for d in ("Up", "Down"))
        sine_up, sine_down = (np.sin(gaze[f"eyeLook{d}{side}"][0]) for d in ("Up", "Down"))
        lids = (up * sine_up + down * sine_down) / (sine_up**2 + sine_down**2)
        follow_sine(joint, lids)
    return basis


@dataclass(frozen=True)
class ExpressionSpace:
    """Attributes:
    basis: (V, 3, 50) metres per standard deviation, orthogonal columns.
    parity: (50,) +1 symmetric, -1 antisymmetric under mirroring.
    unit_expression: (50, units) coefficients of each unit at full strength.
    """

    basis: Floats
    parity: NDArray[np.int8]
    unit_expression: Floats


def expression_space(
    data: MakeHuman,
    head: BaseHead,
    scale: float,
    units: Units,
    carry: Callable[[Floats], Floats],
    mirror: NDArray[np.int64],
) -> ExpressionSpace:
    """Principal directions of random unit activations, lip shape directions, and the tongue.

    Args:
        carry: base-mesh values to final vertices; ``mirror`` belongs to the final vertices.
    """
    shapes = {n: carry(field) for n, field in units.items()}
    names = [n for n in units if n != "jawOpen" and not n.startswith(("eyeLook", "tongue"))]
    fields = np.stack([shapes[n].ravel() for n in names], axis=1) @ _covariance_root(names)
    columns, parity = [], []
    for sign in (1, -1):
        left, size, _ = np.linalg.svd((fields + sign * _flip(fields, mirror)) / 2, False)
        rank = int((size > 1e-6 * size[0]).sum())
        columns.append(left[:, :rank] * size[:rank])
        parity += [sign] * rank
    faces = np.concatenate(columns, axis=1)
    order = np.argsort(-np.linalg.norm(faces, axis=0), kind="stable")
    basis, parity = faces[:, order], [parity[i] for i in order]

    tongue = _orthogonal_to(basis, shapes["tongueOut"].reshape(-1, 1)) * 0.3
    lips = np.stack([carry(_lip_field(data, head, scale, pair)).ravel() for pair in _LIPS], axis=1)
    lips = _orthogonal_to(np.concatenate([basis, tongue], axis=1), lips)
    left, size, _ = np.linalg.svd((lips + _flip(lips, mirror)) / 2, full_matrices=False)
    room = EXPRESSION_SIZE - basis.shape[1] - 1
    basis = np.concatenate([basis, left[:, :room] * size[:room] * LIP_SPREAD, tongue], axis=1)
    parity += [1] * (room + 1)
    largest = basis[np.abs(basis).argmax(0), np.arange(EXPRESSION_SIZE)]
    basis = basis * np.where(largest < 0, -1.0, 1.0)

    project = basis / (basis**2).sum(0)  # the columns are orthogonal
    unit_expression = np.zeros((EXPRESSION_SIZE, len(units)))
    for i, name in enumerate(units):
        if name in names or name == "tongueOut":
            unit_expression[:, i] = project.T @ shapes[name].ravel()
    return ExpressionSpace(
        basis.reshape(-1, 3, EXPRESSION_SIZE), np.array(parity, np.int8), unit_expression
    )


def _lip_field(data: MakeHuman, head: BaseHead, scale: float, pair: tuple[str, str]) -> Floats:
    plus, minus = (data.target(f"mouth/mouth-{name}")[head.ids] for name in pair)
    return (plus.astype(np.float64) - minus) * scale / 2


def _covariance_root(names: list[str]) -> Floats:
    """Symmetric square root of the second moments of plausible activations."""
    rng = np.random.default_rng(1)
    active = np.minimum(rng.exponential(0.25, (4000, len(names))), 1)
    for i, name in enumerate(names):
        if name.endswith("Left") and not name.startswith(("mouthLeft", "jaw")):
            other = names.index(opposite(name))
            active[:, other] = (0.85 * active[:, i] + 0.15 * active[:, other]).clip(0, 1)
    moments = active.T @ active / len(active)
    swap = [names.index(opposite(n)) for n in names]
    moments = (moments + moments[np.ix_(swap, swap)]) / 2
    values, vectors = np.linalg.eigh(moments)
    return np.asarray((vectors * np.sqrt(values.clip(0))) @ vectors.T)


def _flip(columns: Floats, mirror: NDArray[np.int64]) -> Floats:
    fields = columns.reshape(-1, 3, columns.shape[1])
    return np.asarray(fields[mirror] * FLIP[:, None]).reshape(columns.shape)


def _orthogonal_to(basis: Floats, columns: Floats) -> Floats:
    unit = basis / np.linalg.norm(basis, axis=0)
    return np.asarray(columns - unit @ (unit.T @ columns))


def _rigid(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    _, rotation, _ = similarity(a, b)
    return rotation, b.mean(0) - rotation @ a.mean(0)


def _about_x(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
