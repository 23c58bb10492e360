"""Which pixels of a driven frame show what the source did not: drawn through the mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cvthead.deformation import DeformationModel
from cvthead.evaluation.methods import Drawn, Method, Person, coloured_mesh, mesh_draw
from cvthead.evaluation.shots import Shot
from cvthead.points import PointLayout
from cvthead.source import read_source

Mask = NDArray[np.bool_]

UNSEEN, HIDDEN = "unseen", "hidden"


def visibility(deformer: DeformationModel, layout: PointLayout) -> Method:
    """Prepares a person whose picture is red where the source saw the nearest vertex and green
    where that vertex lay on the person within the source picture."""

    def prepare(source: Shot) -> Person:
        mesh = coloured_mesh(deformer, source)
        seen = read_source(deformer, layout, source.head)
        shell = len(mesh.deformation.shell_anchor)
        # The mesh has no midpoints of edges.
        of_mesh = np.r_[: layout.vertices, layout.surface : layout.surface + shell]
        marks = [seen.visible[of_mesh], seen.drawn[of_mesh], np.zeros(len(of_mesh))]
        marked = replace(mesh, colours=np.stack(marks, axis=1).astype(np.float32))
        place = source.head.coefficients, source.head.camera
        return Person(*place, "open", deformer.head, mesh_draw(marked), lambda driver: driver.face)

    return prepare


def regions(drawn: Drawn, driver: Shot) -> dict[str, Mask]:
    """Pixels (S, S) of the driving person by what the source knew.

    Returns:
        ``UNSEEN``: the source did not see the nearest vertex. ``HIDDEN``: those of them whose
        vertex was turned away or covered, not cut off by the edge of the source picture.
    """
    person = (driver.head.mask > 0.5) & driver.head.valid & (drawn.alpha > 0.5)
    unseen = person & (drawn.rgb[..., 0] < 128)
    return {UNSEEN: unseen, HIDDEN: unseen & (drawn.rgb[..., 1] >= 128)}
