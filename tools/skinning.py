"""Skinning weights, region labels and the joint regressor of the head."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvthead.head.mesh import edges
from cvthead.head.model import Region
from tools.decimate import linked
from tools.makehuman import MakeHuman
from tools.topology import Part

Floats = NDArray[np.float64]

CANDIDATES = 2500
# How strongly a joint may follow identity samples against how still it keeps in expressions.
STILLNESS = 30.0
# Share of the mean vertex variance; keeps single weights under about 0.25.
RIDGE = 3e-3


@dataclass(frozen=True)
class BoneFields:
    """(B,) shares of MakeHuman's bones: the skull, and the whole head with a soft neck."""

    skull: Floats
    head: Floats


def bone_fields(data: MakeHuman, ids: NDArray[np.int64]) -> BoneFields:
    weights = {bone: field[ids] for bone, field in data.bone_weights().items()}
    total = np.sum(list(weights.values()), axis=0)
    total[total == 0] = 1
    parents = data.bone_tree()

    def below(bone: str) -> list[str]:
        children = [b for b, parent in parents.items() if parent == bone]
        return [bone] + [d for child in children for d in below(child)]

    def share(*bones: str) -> Floats:
        fields = [weights[b] for b in bones if b in weights]
        return np.asarray(np.sum(fields, axis=0) / total)

    skull = share(*below("head"))
    soft = 0.8 * share("neck03") + 0.5 * share("neck02") + 0.2 * share("neck01")
    return BoneFields(skull, (skull + soft).clip(0, 1))


def linear_blend_weights(head: Floats, jaw: Floats, part: NDArray[np.int64]) -> Floats:
    """(B, 5) weights of root, neck, jaw, left eye, right eye; rows sum to 1.

    MakeHuman's neck bends evenly along its bones. Ours has one joint, at the top: the lower a
    vertex lies, the less it may follow, or the throat swings out behind the chin.
    """
    head = head**3 * (3 - 2 * head)
    weights = np.zeros((len(part), 5))
    weights[:, 3] = part == Part.LEFT_EYE
    weights[:, 4] = part == Part.RIGHT_EYE
    weights[:, 2] = jaw * head
    weights[:, 1] = (head - weights[:, 2:].sum(1)).clip(0)
    weights[:, 0] = 1 - head
    return np.asarray(weights / weights.sum(1, keepdims=True))


def regions(
    base: Floats, skull: Floats, head: Floats, part: NDArray[np.int64]
) -> NDArray[np.uint8]:
    """(N,) Region of every vertex; ``base`` in MakeHuman's decimetres."""
    label = np.full(len(part), Region.SHOULDERS, np.uint8)
    label[head > 0.15] = Region.NECK
    on_skull = (skull > 0.9) & (base[:, 1] > 6.15)
    label[on_skull] = Region.SCALP
    label[on_skull & (base[:, 2] > 0.6) & (base[:, 1] < 8.0)] = Region.FACE
    # An ellipse around each ear, seen from the side.
    ear = ((base[:, 1] - 7.09) / 0.31) ** 2 + ((base[:, 2] - 0.53) / 0.21) ** 2 < 1
    label[on_skull & ear & (np.abs(base[:, 0]) > 0.5)] = Region.EARS
    label[np.isin(part, [Part.LEFT_EYE, Part.RIGHT_EYE])] = Region.EYES
    label[np.isin(part, [Part.UPPER_TEETH, Part.LOWER_TEETH, Part.TONGUE])] = Region.MOUTH
    return label


def scalp_in_one_piece(region: NDArray[np.uint8], faces: NDArray[np.integer]) -> NDArray[np.uint8]:
    """(N,) without the few vertices under the ears that would be islands of hair in the neck."""
    scalp = np.flatnonzero(region == Region.SCALP)
    pairs = edges(faces.astype(np.int32))
    piece = linked(len(region), pairs[(region[pairs] == Region.SCALP).all(axis=1)])[scalp]
    out = region.copy()
    out[scalp[piece != np.bincount(piece).argmax()]] = Region.NECK
    return out


def joint_regressor(
    targets: Mapping[int, Floats],
    samples: NDArray[np.float32],
    expression: Floats,
    part: NDArray[np.int64],
    mirror: NDArray[np.int64],
) -> Floats:
    """(5, N) rows that sum to 1 and give the joints of every sample.

    Exact on the mean sample. The root, neck and jaw rows are also solved to keep still under
    the expression basis (N, 3, 50), because the joints are taken from the expressive vertices.

    Args:
        targets: joint index -> (S, 3) positions of root, neck and jaw in the samples.
        samples: (S, N, 3) sampled vertices of the final surface.
    """
    count = len(part)
    regressor = np.zeros((5, count))
    for joint, eye in ((3, Part.LEFT_EYE), (4, Part.RIGHT_EYE)):
        regressor[joint, part == eye] = 1 / (part == eye).sum()
    mean = samples.mean(0, dtype=np.float64)
    body = np.nonzero(part == Part.BODY)[0]
    for joint, target in targets.items():
        centre = target.mean(0)
        distance = np.linalg.norm(mean[body] - centre, axis=1)
        near = body[np.argsort(distance, kind="stable")[:CANDIDATES]]
        near = np.union1d(near, mirror[near])
        x = samples[:, near].astype(np.float64) - mean[near]
        normal = sum(x[:, :, axis].T @ x[:, :, axis] for axis in range(3))
        ridge = RIDGE * np.trace(normal) / len(near)
        right = np.einsum("sic,sc->i", x, target - centre)
        e = expression[near].reshape(len(near), -1)
        normal += STILLNESS * len(samples) * e @ e.T
        # Sum 1 and the mean joint are exact constraints.
        bound = np.concatenate([np.ones((1, len(near))), mean[near].T])
        system = np.block(
            [[normal + ridge * np.eye(len(near)), bound.T], [bound, np.zeros((4, 4))]]
        )
        values = np.concatenate([right + ridge / len(near), [1.0], centre])
        row = np.linalg.solve(system, values)[: len(near)]
        regressor[joint, near] = row
        regressor[joint] = (regressor[joint] + regressor[joint, mirror]) / 2
    return regressor
