"""Builds ``cvthead/assets/open_hierarchy.npz``: three resolutions of a head mesh::

    python -m tools.build_hierarchy [--head PATH] -o cvthead/assets/open_hierarchy.npz

Trained weights depend on these tables: a change here needs a new training.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvthead.coefficients import Coefficients
from cvthead.head.hierarchy import SPIRAL_LENGTH
from cvthead.head.model import HeadModel
from tools.closest import closest_points
from tools.decimate import components, decimate
from tools.npz import write_npz
from tools.spirals import spirals

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FACTOR = 4
LEVELS = 2
# Smallest number of vertices of a component (eyeball, row of teeth) by level.
LEAST = (24, 9)
# The lips are apart in the geometry that decides on neighbours.
JAW_OPEN = 0.35


def build(head: HeadModel) -> dict[str, NDArray[np.generic]]:
    points = with_open_jaw(head)
    faces = head.faces.astype(np.int64)
    arrays: dict[str, NDArray[np.generic]] = {}
    for level in range(LEVELS):
        arrays[f"spirals_{level}"] = spirals(points, faces, SPIRAL_LENGTH).astype(np.int16)
        coarse = decimate(points, faces, len(points) // FACTOR, LEAST[level])
        indices, weights = unpool(points, faces, coarse.kept, coarse.faces)
        arrays[f"down_{level}"] = coarse.kept.astype(np.int16)
        arrays[f"up_indices_{level}"] = indices.astype(np.int16)
        arrays[f"up_weights_{level}"] = weights.astype(np.float32)
        points, faces = points[coarse.kept], coarse.faces
        print(f"level {level + 1}: {len(points)} vertices, {len(faces)} faces")
    return arrays


def with_open_jaw(head: HeadModel) -> Floats:
    """(N, 3) template with the lips apart.

    The mesh is symmetric, so the last bit of a coordinate decides between two equally good
    collapses. This keeps one fixed arithmetic, whatever HeadModel does to be fast.
    """
    pose = Coefficients.zeros().with_joints({"jaw": [JAW_OPEN, 0, 0]}).pose
    transforms = head.transforms(pose, head.joints(head.template))
    rest = head.template + head.pose_offsets(pose)
    blended = (head.weights @ transforms.reshape(-1, 12)).reshape(-1, 3, 4)
    turned = np.matmul(blended[:, :, :3], rest[:, :, None])[:, :, 0]
    return np.asarray(turned + blended[:, :, 3], np.float64)


def unpool(points: Floats, faces: Ints, kept: Ints, coarse_faces: Ints) -> tuple[Ints, Floats]:
    """(N, 3) coarse vertices and barycentric weights of the nearest place on the coarse mesh.

    Each component looks at its own coarse faces only.
    """
    label = components(len(points), faces)
    indices = np.empty((len(points), 3), np.int64)
    weights = np.empty((len(points), 3))
    face_label = label[kept[coarse_faces[:, 0]]]
    for component in np.unique(label):
        own = coarse_faces[face_label == component]
        here = label == component
        face, weights[here] = closest_points(points[here], points[kept], own)
        indices[here] = own[face]
    return indices, weights


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--head", type=Path, help="head model; the packaged one if absent")
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    write_npz(arguments.output, build(HeadModel.load(arguments.head)))


if __name__ == "__main__":
    main()
