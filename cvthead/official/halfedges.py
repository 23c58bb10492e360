"""The order in which OpenMesh walks around a vertex, which the released spirals depend on.

A vertex's ring starts at the half-edge that the mesh stored for it, and which one that is
follows from the order in which the faces were added: OpenMesh's rule, reproduced here.
"""

from __future__ import annotations

from collections.abc import Iterable

NONE = -1


class HalfedgeMesh:
    """Triangles added one by one. Half-edges come in pairs; the opposite of h is ``h ^ 1``.

    Args:
        vertices: how many there are.
        faces: vertex triples, counter-clockwise. One that would give an edge a third face, or
            touch a vertex that is closed already, is left out, as OpenMesh does.
    """

    def __init__(self, vertices: int, faces: Iterable[tuple[int, int, int]]) -> None:
        self.outgoing = [NONE] * vertices
        self.target: list[int] = []
        self.next: list[int] = []
        self.previous: list[int] = []
        self.has_face: list[bool] = []
        self.between: dict[tuple[int, int], int] = {}
        for face in faces:
            self._add(face)

    def ring(self, vertex: int) -> list[int]:
        """Neighbours clockwise, from the stored outgoing half-edge on."""
        return [self.target[h] for h in self._around(vertex)]

    def _around(self, vertex: int) -> list[int]:
        first = self.outgoing[vertex]
        found: list[int] = []
        h = first
        while h != NONE and (not found or h != first):
            found.append(h)
            h = self.next[h ^ 1]
        return found

    def _add(self, face: tuple[int, int, int]) -> None:
        sides = [(face[i], face[(i + 1) % 3]) for i in range(3)]
        halfedges = [self.between.get(side, NONE) for side in sides]
        new = [h == NONE for h in halfedges]
        if any(not self._open(v) for v in face) or any(
            h != NONE and self.has_face[h] for h in halfedges
        ):
            return
        if not all(self._join(halfedges[i], halfedges[(i + 1) % 3]) for i in range(3)):
            return
        for i, (start, end) in enumerate(sides):
            if new[i]:
                halfedges[i] = self._new_edge(start, end)
        links: list[tuple[int, int]] = []
        adjust = []
        for i in range(3):
            j = (i + 1) % 3
            vertex, inner_previous, inner_next = face[j], halfedges[i], halfedges[j]
            if new[i] or new[j]:
                links += self._outer_links(vertex, inner_previous, inner_next, new[i], new[j])
                links.append((inner_previous, inner_next))
            elif self.outgoing[vertex] == inner_next:
                adjust.append(vertex)
            self.has_face[inner_previous] = True
        for before, after in links:
            self._link(before, after)
        for vertex in adjust:
            self._prefer_border(vertex)

    def _open(self, vertex: int) -> bool:
        h = self.outgoing[vertex]
        return h == NONE or not self.has_face[h]

    def _new_edge(self, start: int, end: int) -> int:
        h = len(self.target)
        self.target += [end, start]
        self.next += [NONE, NONE]
        self.previous += [NONE, NONE]
        self.has_face += [False, False]
        self.between[start, end], self.between[end, start] = h, h + 1
        return h

    def _link(self, before: int, after: int) -> None:
        self.next[before], self.previous[after] = after, before

    def _join(self, before: int, after: int) -> bool:
        """Make two existing neighbours of the new face consecutive by moving what lies between
        them to another gap around their vertex. False where there is no other gap."""
        if NONE in (before, after) or self.next[before] == after:
            return True
        gap = after ^ 1
        while True:
            gap = self.next[gap] ^ 1
            if not self.has_face[gap]:
                break
        if gap == before:
            return False
        behind_gap = self.next[gap]
        patch_start, patch_end = self.next[before], self.previous[after]
        self._link(gap, patch_start)
        self._link(patch_end, behind_gap)
        self._link(before, after)
        return True

    def _outer_links(
        self, vertex: int, before: int, after: int, new_before: bool, new_after: bool
    ) -> list[tuple[int, int]]:
        """Links of the border around the new face at ``vertex``, whose half-edge is set too."""
        outer_before, outer_after = after ^ 1, before ^ 1
        if not new_after:
            links = [(self.previous[after], outer_after)]
            self.outgoing[vertex] = outer_after
        elif not new_before:
            links = [(outer_before, self.next[before])]
            self.outgoing[vertex] = self.next[before]
        elif self.outgoing[vertex] == NONE:
            links = [(outer_before, outer_after)]
            self.outgoing[vertex] = outer_after
        else:
            border = self.outgoing[vertex]
            links = [(self.previous[border], outer_after), (outer_before, border)]
        return links

    def _prefer_border(self, vertex: int) -> None:
        for h in self._around(vertex):
            if not self.has_face[h]:
                self.outgoing[vertex] = h
                return
