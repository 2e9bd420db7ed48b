"""The triangle table of marching cubes, derived from the cube's geometry instead of typed in.

Corner c of a cell sits at (c & 1, c >> 1 & 1, c >> 2 & 1). Where a face of the cell is ambiguous (two inside corners
across the diagonal), the inside corners are kept apart. That choice depends on the face alone, so neighbouring cells
agree and the surface has no holes. No diagonal of a polygon lies in a face of its cell, so it is a manifold too.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)], np.int64)

# Edge e runs from corner EDGE_CORNER[e] along axis EDGE_AXIS[e].
EDGE_CORNER, EDGE_AXIS = np.array([(c, a) for c in range(8) for a in range(3) if not c >> a & 1], np.int64).T

_EDGE_ENDS = [frozenset((int(c), int(c | 1 << a))) for c, a in zip(EDGE_CORNER, EDGE_AXIS, strict=True)]


def _rings() -> list[list[int]]:
    """The corners of the six faces, counter-clockwise when seen from outside the cell."""
    rings = []
    for axis, side in itertools.product(range(3), range(2)):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        base = side << axis
        ring = [base, base | u, base | u | v, base | v]
        rings.append(ring if side else ring[::-1])
    return rings


_RINGS = _rings()


def _polygons(case: int) -> list[list[int]]:
    """Closed loops of cut edges around the inside corners (the set bits of ``case``)."""
    follows: dict[int, int] = {}
    for ring in _RINGS:
        inside = [bool(case >> corner & 1) for corner in ring]
        cuts = [_EDGE_ENDS.index(frozenset((ring[i], ring[(i + 1) % 4]))) for i in range(4)]
        for leave in range(4):
            if inside[leave] and not inside[(leave + 1) % 4]:
                enter = next(i % 4 for i in range(leave + 3, leave, -1) if not inside[i % 4])
                follows[cuts[enter]] = cuts[leave]
    loops = []
    while follows:
        start, edge = follows.popitem()
        loop = [start]
        while edge != start:
            loop.append(edge)
            edge = follows.pop(edge)
        loops.append(loop)
    return loops


def _share_face(a: int, b: int) -> bool:
    return any(_EDGE_ENDS[a] | _EDGE_ENDS[b] <= set(ring) for ring in _RINGS)


def _fan(loop: list[int]) -> list[int]:
    """Triangles of a polygon, three edges each, as a fan whose diagonals lie in no face of the cell."""
    n = len(loop)
    turns = (loop[r:] + loop[:r] for r in range(n))
    tip, *rest = next(turn for turn in turns if not any(_share_face(turn[0], edge) for edge in turn[2 : n - 1]))
    return [edge for a, b in itertools.pairwise(rest) for edge in (tip, a, b)]


def _table() -> NDArray[np.int64]:
    """[256, 15]: up to five triangles per case as edge numbers, padded with -1, facing away from the inside."""
    table = np.full((256, 15), -1, np.int64)
    for case in range(256):
        edges = [edge for loop in _polygons(case) for edge in _fan(loop)]
        table[case, : len(edges)] = edges
    return table


TRIANGLES = _table()
