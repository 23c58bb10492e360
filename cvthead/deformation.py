"""Hair and shoulders: the head model's surface drawn out to the person's silhouette.

A parametric head is bald. Where the paper regresses vertex offsets for hair and shoulders with
a network (section 3.2, the term f_H), the open preset fits them to the person mask of the
source picture: scalp, neck and shoulders follow the silhouette (cvthead/outline.py), and shell
points fill what the mesh cannot reach.

Everything is stored in rest space, before skinning, so that hair turns with the head.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cvthead.camera import CROP_PIXELS, Camera
from cvthead.coefficients import Coefficients
from cvthead.errors import AssetError, FaceError
from cvthead.head.mesh import vertex_normals
from cvthead.head.model import HeadModel, Region
from cvthead.outline import OutlineModel
from cvthead.silhouette import Mask, Points, distance_to_points, pixel_of, signed_distance

Array = NDArray[np.float32]

MAX_EAR_OFFSET = 0.005  # metres
HAIR_FORWARD = 0.01  # metres
MAX_SHELL_POINTS = 512
# Pixels of the 256 x 256 crop, which spans 0.36 m.
SHELL_SPACING = 4.5
SHELL_REACH = 32.0  # from the mesh; what is farther is another person or a thing
SHELL_MARGIN = 1.5  # from the edge of the mask, where the background shines through


@dataclass(frozen=True, eq=False)
class Deformation:
    """Hair and shoulders of one person, in rest space (metres of head space, before skinning).

    Attributes:
        offsets: (N, 3) displacement of each vertex of the head.
        shell_anchor: (K,) int32, the vertex each shell point moves with; K <= 512.
        shell_offset: (K, 3) from the displaced rest position of the anchor to the point.
    """

    offsets: Array
    shell_anchor: NDArray[np.int32]
    shell_offset: Array

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            constant = getattr(self, name).view()
            constant.flags.writeable = False  # an avatar's is shared between threads
            object.__setattr__(self, name, constant)

    @classmethod
    def none(cls, head: HeadModel) -> Deformation:
        """The bald head: no displacement, no shell."""
        return cls(
            np.zeros((len(head.template), 3), np.float32),
            np.zeros(0, np.int32),
            np.zeros((0, 3), np.float32),
        )


def points(head: HeadModel, coefficients: Coefficients, deformation: Deformation) -> Array:
    """Posed vertices, then shell points: (N + K, 3) in metres of head space.

    A shell point is skinned with the weights of its anchor.
    """
    shell = (deformation.shell_anchor, deformation.shell_offset)
    return head.posed(coefficients, deformation.offsets, shell if len(shell[0]) else None)


def inside(positions: Array, camera: Camera, mask: Mask) -> Mask:
    """Which posed points (P, 3) project into the mask: (P,) bool.

    The others lie on the background of the source picture; no colour must be read there.

    Args:
        positions: (P, 3) metres.
        camera: in normalised coordinates of the crop.
        mask: (S, S) of the same crop.
    """
    size = mask.shape[0]
    within, column, row = pixel_of(to_pixels(camera.project(positions), size), size)
    return np.asarray(within & mask[row, column])


def to_pixels(projected: Points, size: int = CROP_PIXELS) -> NDArray[np.float64]:
    """Normalised coordinates (..., 2 or 3) of a crop -> (..., 2) continuous pixels."""
    return np.asarray((projected[..., :2] + 1.0) * (size / 2), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class DeformationModel:
    """What fitting needs of a head and can be made once (about 30 ms).

    Attributes:
        head: the head model.
        outline: the least squares of the silhouette.
        carriers: (C,) vertices a shell point may hang on: scalp, neck, shoulders.
    """

    head: HeadModel
    outline: OutlineModel
    carriers: NDArray[np.intp]

    @classmethod
    def from_head(cls, head: HeadModel) -> DeformationModel:
        """Raises AssetError if the head model does not say which vertices are which."""
        if len(head.region) != len(head.template):
            raise AssetError(
                "the head model has no regions, so hair and shoulders cannot be fitted",
                hint="use the open head, or Deformation.none(head)",
            )
        outline = OutlineModel.from_head(head)
        return cls(head, outline, np.flatnonzero(outline.pulled))

    def fit(
        self, coefficients: Coefficients, camera: Camera, mask: Mask, valid: Mask
    ) -> Deformation:
        """Fit hair and shoulders to the person's silhouette.

        Args:
            coefficients: of the tracked source picture.
            camera: in normalised coordinates of the crop.
            mask: (256, 256), the person, cleaned by silhouette.person_mask.
            valid: (256, 256), False where the crop lies beyond the picture.

        Returns:
            Face, eyes and mouth do not move, ears by at most 5 mm.

        Raises:
            FaceError: the mask does not touch the face.
        """
        head, mask = self.head, mask & valid
        posed = head.vertices(coefficients)
        if not inside(posed[head.region == Region.FACE], camera, mask).any():
            raise FaceError(
                "the person mask does not touch the face",
                hint="pass the mask of the crop that the camera belongs to, "
                "or do without hair: Deformation.none(head)",
            )
        normals = vertex_normals(posed, head.faces)
        moved = self.outline.fit(to_pixels(camera.project(posed)), mask, valid)
        metres = np.array([2, -2]) / (CROP_PIXELS * camera.scale)  # for one pixel right, down
        view = np.zeros_like(posed)
        view[:, :2] = moved * metres
        # The back of the scalp moves back by as much as the scalp moves in the picture on
        # average, so that hair keeps a volume when the head turns.
        scalp = head.region == Region.SCALP
        back = np.minimum(normals[:, 2], 0) * np.linalg.norm(view[scalp], axis=1).mean()
        # Hair at the sides and above the forehead lies in front of the scalp it grows from.
        thickness = (view * normals).sum(axis=1).clip(0, HAIR_FORWARD)
        front = thickness * np.clip(1 + 2 * normals[:, 2], 0, 1)
        view[:, 2] = np.where(scalp, back + front, 0)

        unposed = inverse_rotations(head, coefficients)
        offsets = np.einsum("nij,nj->ni", unposed, view)
        ears = head.region == Region.EARS
        length = np.linalg.norm(offsets[ears], axis=1, keepdims=True)
        offsets[ears] *= np.minimum(1, MAX_EAR_OFFSET / np.maximum(length, 1e-9))

        flat = to_pixels(camera.project(head.posed(coefficients, offsets)))
        spots = shell_spots(flat, mask)
        # Far-side vertices share the outline with near-side ones, but hair hung on them would
        # sink into the head or the chest.
        near = self.carriers[normals[self.carriers, 2] > -0.2]
        anchor = near[cKDTree(flat[near]).query(spots)[1]]
        view = np.zeros((len(spots), 3), np.float32)
        view[:, :2] = (spots - flat[anchor]) * metres
        shell = np.einsum("nij,nj->ni", unposed[anchor], view)
        return Deformation(offsets, anchor.astype(np.int32), shell)


def fit(
    head: HeadModel, coefficients: Coefficients, camera: Camera, mask: Mask, valid: Mask
) -> Deformation:
    """DeformationModel.fit for a single picture; keep a DeformationModel for many."""
    return DeformationModel.from_head(head).fit(coefficients, camera, mask, valid)


def shell_spots(flat: Points, mask: Mask) -> NDArray[np.float64]:
    """Where the mask is not covered: (K, 2) pixels, K <= 512.

    Greedy: always the pixel of the mask farthest from every point, until none is farther than
    SHELL_SPACING. Keeps SHELL_MARGIN from the edge and SHELL_REACH from the mesh.
    """
    size = mask.shape[0]
    gap = distance_to_points(flat, size)
    gap[(gap > SHELL_REACH) | (signed_distance(mask) < SHELL_MARGIN)] = 0
    steps = np.arange(size)
    spots = np.empty((MAX_SHELL_POINTS, 2))
    for count in range(MAX_SHELL_POINTS):
        row, column = divmod(int(gap.argmax()), size)
        radius = float(gap[row, column])
        if radius <= SHELL_SPACING:
            return spots[:count]
        spots[count] = column + 0.5, row + 0.5
        # No gap exceeds the radius, so farther pixels cannot get nearer.
        reach = int(radius) + 1
        rows = slice(max(0, row - reach), row + reach + 1)
        columns = slice(max(0, column - reach), column + reach + 1)
        distance = np.hypot(steps[rows, None] - row, steps[None, columns] - column)
        gap[rows, columns] = np.minimum(gap[rows, columns], distance)
    return spots


def inverse_rotations(head: HeadModel, coefficients: Coefficients) -> Array:
    """(N, 3, 3): takes a displacement of each posed vertex back to rest space."""
    joints = head.joints(head.rest(coefficients))
    rotations = head.transforms(coefficients.pose, joints)[:, :, :3].reshape(-1, 9)
    return np.asarray(np.linalg.inv((head.weights @ rotations).reshape(-1, 3, 3)))
