"""Random MakeHuman identities, aligned on the skull, and their principal components.

The sample set is closed under mirroring, so the principal components split exactly into
symmetric and antisymmetric ones; each is computed in its own half-space.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tools.makehuman import BaseMesh, MakeHuman

Floats = NDArray[np.float64]
Samples = NDArray[np.float32]

SAMPLE_COUNT = 1600
FLIP = np.array([-1.0, 1.0, 1.0], np.float32)

_LEVELS = {
    "gender": ("male", "female"),
    "age": ("young", "old"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "maxheight"),
    "proportions": ("idealproportions", "uncommonproportions"),
    "race": ("african", "asian", "caucasian"),
}
# Spread of the local modifiers by category, chosen so that drawn heads stay plausible.
_SPREAD = {
    "head": 0.3, "nose": 0.38, "mouth": 0.38, "eyes": 0.38, "ears": 0.4, "cheek": 0.45,
    "chin": 0.42, "forehead": 0.45, "eyebrows": 0.4, "neck": 0.3, "asym": 0.22,
}  # fmt: skip
_OPPOSITES = (
    ("decr", "incr"), ("down", "up"), ("in", "out"), ("backward", "forward"),
    ("concave", "convex"), ("compress", "uncompress"),
)  # fmt: skip


@dataclass(frozen=True)
class _Modifier:
    """One slider: target index for negative values and, if it has one, for positive values."""

    category: str
    name: str
    negative: int
    positive: int | None


@dataclass(frozen=True)
class _Targets:
    """Displacements (T, rows, 3) in decimetres; the macro targets come first."""

    fields: NDArray[np.float32]
    macros: list[tuple[str, ...]]
    modifiers: list[_Modifier]


@dataclass(frozen=True)
class Alignment:
    """Metres from the base mesh: ``scale * decimetres - origin`` for the mean sample."""

    scale: float
    origin: Floats


def _macro_paths() -> list[tuple[str, tuple[str, ...]]]:
    """Path and the factors whose product is the weight, of every macro target."""
    paths: list[tuple[str, tuple[str, ...]]] = []
    for gender, age in itertools.product(_LEVELS["gender"], _LEVELS["age"]):
        paths += [
            (f"macrodetails/{race}-{gender}-{age}", (gender, age, race)) for race in _LEVELS["race"]
        ]
        for muscle, weight in itertools.product(_LEVELS["muscle"], _LEVELS["weight"]):
            body = (gender, age, muscle, weight)
            stem = "-".join(body)
            paths.append((f"macrodetails/universal-{stem}", body))
            for kind in ("height", "proportions"):
                paths += [
                    (f"macrodetails/{kind}/{stem}-{level}", (*body, level))
                    for level in _LEVELS[kind]
                ]
    return paths


def _read_targets(data: MakeHuman, rows: NDArray[np.int64]) -> _Targets:
    macros = _macro_paths()
    fields = [data.target(path)[rows] for path, _ in macros]
    modifiers = []
    for category in _SPREAD:
        names = data.target_names(category)
        seen: set[str] = set()
        for name in names:
            if name in seen or "breast" in name or "trunk" in name:
                continue
            opposite = None
            for low, high in _OPPOSITES:
                if name.endswith("-" + low) and name[: -len(low)] + high in names:
                    opposite = name[: -len(low)] + high
            if category == "asym" and name.endswith("-l"):
                opposite = name[:-1] + "r"
            positive = None
            if opposite is not None:
                seen.add(opposite)
                positive = len(fields)
                fields.append(data.target(f"{category}/{opposite}")[rows])
            modifiers.append(_Modifier(category, name, len(fields), positive))
            fields.append(data.target(f"{category}/{name}")[rows])
    return _Targets(np.array(fields), [factors for _, factors in macros], modifiers)


def _between(x: float, names: tuple[str, ...]) -> dict[str, float]:
    """Linear interpolation weights of ``x`` in 0..1 over the named levels."""
    place = np.clip(x, 0, 1) * (len(names) - 1)
    low = min(int(place), len(names) - 2)
    weights = dict.fromkeys(names, 0.0)
    weights[names[low]], weights[names[low + 1]] = 1 - (place - low), place - low
    return weights


def _draw(targets: _Targets, rng: np.random.Generator) -> NDArray[np.float32]:
    """Target weights (T,) of one random person."""
    level: dict[str, float] = {}
    level |= _between(rng.beta(0.5, 0.5), _LEVELS["gender"])
    level |= _between(rng.uniform(-0.1, 1 if rng.random() < 0.5 else 0.4), _LEVELS["age"])
    level |= _between(rng.beta(3, 3), _LEVELS["muscle"])
    level |= _between(rng.beta(2.2, 2.2), _LEVELS["weight"])
    level |= _between(rng.beta(3, 3), _LEVELS["height"])
    level |= _between(rng.beta(3, 3), _LEVELS["proportions"])
    level |= dict(zip(_LEVELS["race"], rng.dirichlet([0.5, 0.5, 0.5]), strict=True))
    weights = np.zeros(len(targets.fields), np.float32)
    weights[: len(targets.macros)] = [
        np.prod([level[factor] for factor in factors]) for factors in targets.macros
    ]
    first_side: dict[str, float] = {}
    for modifier in targets.modifiers:
        spread = _SPREAD[modifier.category]
        if "trans" in modifier.name and modifier.category in ("head", "neck"):
            spread *= 0.5
        x = rng.normal(0, spread) * (rng.random() < 0.8)
        sided = re.match(r"^[lr]-(.*)$", modifier.name)
        if sided and modifier.category != "asym":  # faces are nearly symmetric
            if sided.group(1) in first_side:
                x = first_side[sided.group(1)] + rng.normal(0, 0.08)
            first_side[sided.group(1)] = x
        x = float(np.clip(x, -1, 1))
        if modifier.positive is not None:
            weights[modifier.positive if x > 0 else modifier.negative] += abs(x)
        elif x > 0:
            weights[modifier.negative] += 0.8 * x
    return weights


def similarity(a: Floats, b: Floats) -> tuple[float, Floats, Floats]:
    """Scale, rotation and translation with ``b ~ scale * a @ rotation.T + translation``."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    u, s, vt = np.linalg.svd((a - mean_a).T @ (b - mean_b))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = (vt.T * sign) @ u.T
    scale = float((s * sign).sum() / ((a - mean_a) ** 2).sum())
    return scale, rotation, mean_b - scale * rotation @ mean_a


def sample_identities(
    data: MakeHuman,
    mesh: BaseMesh,
    rows: NDArray[np.int64],
    skull: NDArray[np.bool_],
    mirror: NDArray[np.int64],
    origin_rows: NDArray[np.int64],
) -> tuple[Samples, Alignment]:
    """Random heads without their size and place.

    Args:
        rows: (R,) MakeHuman vertices to sample.
        skull: (R,) rows that the similarity alignment uses.
        mirror: (R,) mirrored row of every row.
        origin_rows: rows whose mean becomes the origin.

    Returns:
        (2 S, R, 3) float32 metres, the second half mirrored, and the base mesh's alignment.
    """
    targets = _read_targets(data, rows)
    rng = np.random.default_rng(0)
    weights = np.array([_draw(targets, rng) for _ in range(SAMPLE_COUNT)])
    offsets = weights @ targets.fields.reshape(len(targets.fields), -1)
    samples = (mesh.vertices[rows].astype(np.float32).reshape(1, -1) + offsets) * np.float32(0.1)
    samples = samples.reshape(SAMPLE_COUNT, -1, 3)
    reference = samples.mean(0).astype(np.float64)
    reference = (reference + reference[mirror] * FLIP) / 2
    scales = np.ones(SAMPLE_COUNT)
    for _ in range(2):
        aligned = np.empty_like(samples)
        for i, sample in enumerate(samples):
            s, rotation, translation = similarity(sample[skull].astype(float), reference[skull])
            aligned[i] = s * sample @ rotation.T + translation
            scales[i] = s
        reference = aligned.mean(0).astype(np.float64)
        reference = (reference + reference[mirror] * FLIP) / 2
    origin = reference[origin_rows].mean(0)
    aligned -= origin.astype(np.float32)
    both = np.concatenate([aligned, aligned[:, mirror] * FLIP])
    return both, Alignment(0.1 * float(scales.mean()), origin)


def principal_components(
    samples: Samples, mirror: NDArray[np.int64], weight: Floats, count: int
) -> tuple[Floats, NDArray[np.int8], Floats]:
    """Directions that turn N(0, 1) coefficients into the samples' spread.

    Args:
        samples: (2 S, B, 3), the second half mirrored.
        weight: (B,) importance of every vertex.

    Returns:
        (B, 3, count) metres per standard deviation, sorted by weighted variance; (count,) parity:
        +1 symmetric, -1 antisymmetric under mirroring; (count,) explained share, cumulative.
    """
    half = len(samples) // 2
    centred = samples[:half].astype(np.float64) - samples.mean(0, dtype=np.float64)
    flipped = centred[:, mirror] * FLIP
    scaled = weight[:, None]
    directions, variances, parities = [], [], []
    total = 0.0
    for parity in (1, -1):
        part = (centred + parity * flipped) / 2
        flat = (part * scaled).reshape(half, -1)
        values, vectors = np.linalg.eigh(flat @ flat.T / half)
        total += values.clip(0).sum()
        top = np.argsort(-values)[:count]
        # X = mean + directions @ (sqrt(S) u): unit variance over the samples.
        directions.append(part.reshape(half, -1).T @ vectors[:, top] / np.sqrt(half))
        variances.append(values[top])
        parities.append(np.full(len(top), parity, np.int8))
    variance = np.concatenate(variances)
    order = np.argsort(-variance, kind="stable")[:count]
    basis = np.concatenate(directions, axis=1)[:, order]
    # Eigenvectors have no sign of their own: let the largest entry be positive.
    largest = basis[np.abs(basis).argmax(0), np.arange(count)]
    basis = basis * np.where(largest < 0, -1.0, 1.0)
    explained = np.cumsum(variance[order]) / total
    return basis.reshape(-1, 3, count), np.concatenate(parities)[order], explained
