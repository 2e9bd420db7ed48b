"""Triangles cut back to what can be seen of them: without what another solid covers or what lies outside the room.

Corners are float64 [..., 6]: a point and its normal, in the frame of the shape that owns the triangle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .scene import Scene
from .solids import F
from .tracing import build, clearance

# Solids may touch and curved ones are chords, so a surface is covered where points a little above it are deep in
# another solid; the bit of overlap leaves no gap.
LIFT_M, COVER_M = 0.0005, 0.0004
FINEST_M = 0.01
INTERVALS = 4  # of the samples along an edge
SHRINK = 1e-3  # samples keep clear of edges, which often lie exactly on another solid
STRAIGHT_M = 0.0002
HALVINGS = 16
LEAST_M2 = 1e-10

Floats = NDArray[np.float64]
Owners = NDArray[np.intp]
Flags = NDArray[np.bool_]


class Room(NamedTuple):
    """What covers: the scene as ``clearance`` takes it, shapes to world [N, 3, 3] and [N, 3], the room's box [2, 3]."""

    numbers: NDArray[np.int32]
    values: NDArray[np.float32]
    box: NDArray[np.float32]
    skip: NDArray[np.int32]
    leaf: NDArray[np.int32]
    local: NDArray[np.float32]
    rotation: Floats
    center: Floats
    interior: Floats


def trim(scene: Scene, owner: Owners, corners: Floats, interior: Floats) -> tuple[Flags, Owners, Floats]:
    """(which of the triangles can be seen as a whole [F], owners [P] and corners [P, 3, 6] of the visible parts of the
    others).

    owner: [F] shapes; corners: [F, 3, 6], counter-clockwise from outside; interior: the room's box [2, 3] in the world.
    A border of what is seen is found to a fraction of a millimetre where it is straight; elsewhere triangles are
    quartered until it is, or down to ``FINEST_M``.
    """
    room = Room(scene.numbers, scene.values, *build(scene), scene.rotation, scene.center, interior)
    whole, near = _tell_apart(room, owner, corners)
    of, pieces, first = owner[near], corners[near], True
    parts = [(of[:0], pieces[:0])]
    while len(of):
        seen = _seen(room, of, pieces, _normals(pieces)[0], _WEIGHTS)
        full = seen.all(1)
        if first:
            whole[near[full]] = True
        else:
            parts.append((of[full], pieces[full]))
        mixed = seen.any(1) & ~full
        done, cut = _cut(room, of[mixed], pieces[mixed], seen[mixed])
        parts += cut
        of, pieces, first = np.tile(of[mixed][~done], 4), _quarters(pieces[mixed][~done]), False
    return whole, np.concatenate([o for o, _ in parts]), np.concatenate([c for _, c in parts])


def _tell_apart(room: Room, owner: Owners, corners: Floats) -> tuple[Flags, Owners]:
    """From their middles alone: which triangles can surely be seen [F], and the indices of those to look at closer."""
    normal, area = _normals(corners)
    middle = corners[..., :3].mean(1)
    reach = 2 * np.linalg.norm(corners[..., :3] - middle[:, None], axis=2).max(1)
    free = _free_around(room, owner, middle + LIFT_M * normal, reach)
    real = area > LEAST_M2
    return real & (free >= reach), np.flatnonzero(real & (np.abs(free) < reach))


def _cut(room: Room, owner: Owners, corners: Floats, seen: Flags) -> tuple[Flags, list[tuple[Owners, Floats]]]:
    """Which triangles are dealt with [F], and what is left of them. Those with a straight border across two edges are
    cut along it, and so are the finest; of the finest without a border across edges all is left or nothing.

    seen: [F, S] for each of ``_WEIGHTS``.
    """
    order, across, odd_seen = _odd_corner_first(seen[:, :3])
    corners = np.take_along_axis(corners, order[..., None], 1)
    share = _crossings(room, owner, corners, _normals(corners)[0], odd_seen)
    weights = np.take_along_axis(_WEIGHTS[None], order[:, None, :], 2)
    side = weights[..., 1] / share[:, :1] + weights[..., 2] / share[:, 1:] - 1
    size = _longest_edge(corners)
    away = np.abs(side) * (share.min(1) * size)[:, None] > STRAIGHT_M
    straight = across & ~(away & (seen != ((side < 0) == odd_seen[:, None]))).any(1)
    fine = size <= FINEST_M
    cut = across & (straight | fine)
    p = corners[:, 0] + share[:, :1] * (corners[:, 1] - corners[:, 0])
    q = corners[:, 0] + share[:, 1:] * (corners[:, 2] - corners[:, 0])
    tip, base, kept = cut & odd_seen, cut & ~odd_seen, fine & ~across & (seen.mean(1) > 0.5)
    parts = [
        (owner[tip], np.stack([corners[:, 0], p, q], 1)[tip]),
        (owner[base], np.stack([p, corners[:, 1], corners[:, 2]], 1)[base]),
        (owner[base], np.stack([p, corners[:, 2], q], 1)[base]),
        (owner[kept], corners[kept]),
    ]
    return cut | fine, [(o[wide], c[wide]) for o, c in parts for wide in [_wider_than_overlap(c)]]


def _wider_than_overlap(corners: Floats) -> Flags:
    """Which triangles [F] are more than a bit of the overlap."""
    return 2 * _normals(corners)[1] > COVER_M * _longest_edge(corners)


def _longest_edge(corners: Floats) -> Floats:
    return np.linalg.norm(corners[..., :3] - np.roll(corners[..., :3], 1, axis=1), axis=2).max(1)


def _odd_corner_first(seen: Flags) -> tuple[NDArray[np.intp], Flags, Flags]:
    """Of the corners [F, 3]: their cyclic order [F, 3] from the one that differs from the other two, whether there is
    such a one [F], and whether that one is seen [F]."""
    count = seen.sum(1)
    odd = np.where(count == 1, seen.argmax(1), (~seen).argmax(1))
    return (odd[:, None] + np.arange(3)) % 3, (count == 1) | (count == 2), count == 1


def _quarters(corners: Floats) -> Floats:
    """Each triangle as four, by the middles of its edges: [4 F, 3, 6], the first quarters of all first."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def _normals(corners: Floats) -> tuple[Floats, Floats]:
    """Unit normals [F, 3] and areas [F] of triangles."""
    a, b, c = (corners[:, k, :3] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    return normal / np.maximum(length, 1e-20)[:, None], length / 2


def _weights() -> Floats:
    """Barycentric coordinates [S, 3] of points spread evenly over a triangle, its corners first."""
    n = INTERVALS
    grid = [(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]
    spread = np.array([*np.eye(3) * n, *(w for w in grid if max(w) < n)]) / n
    return spread + SHRINK * (1 / 3 - spread)


_WEIGHTS = _weights()


@njit(cache=True, nogil=True)
def _free(room, owner, x, y, z, reach):
    """Distance in metres of a point in its owner's frame to the nearest other solid or to the outside, negative inside
    a solid or outside the room; ``reach`` where that is farther."""
    turn, move, low, high = room.rotation[owner], room.center[owner], room.interior[0], room.interior[1]
    wx = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + move[0]
    wy = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + move[1]
    wz = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + move[2]
    inside = min(wx - low[0], wy - low[1], wz - low[2], high[0] - wx, high[1] - wy, high[2] - wz)
    if inside < -COVER_M:
        return inside
    tree = room.box, room.skip, room.leaf, room.local
    return min(inside, clearance(room.numbers, room.values, *tree, F(wx), F(wy), F(wz), owner, F(reach)))


@njit(cache=True, nogil=True)
def _free_around(room, owner, points, reach):
    out = np.empty(len(points))
    for i in range(len(points)):
        out[i] = _free(room, owner[i], points[i, 0], points[i, 1], points[i, 2], reach[i])
    return out


@njit(cache=True, nogil=True)
def _seen(room, owner, corners, normal, weights):
    """bool [F, S] whether the points of triangles with barycentric ``weights`` [S, 3] can be seen."""
    out = np.empty((len(owner), len(weights)), np.bool_)
    p = np.empty(3)
    for i in range(len(owner)):
        for j in range(len(weights)):
            for k in range(3):
                p[k] = LIFT_M * normal[i, k]
                for c in range(3):
                    p[k] += weights[j, c] * corners[i, c, k]
            out[i, j] = _free(room, owner[i], p[0], p[1], p[2], 0.0) >= -COVER_M
    return out


@njit(cache=True, nogil=True)
def _crossings(room, owner, corners, normal, first_seen):
    """float64 [F, 2]: at which share of the edges from corner 0 to 1 and to 2 the border lies, by bisection."""
    out = np.empty((len(owner), 2))
    p = np.empty(3)
    for i in range(len(owner)):
        for end in range(2):
            low, high = 0.0, 1.0
            for _ in range(HALVINGS):
                middle = (low + high) / 2
                for k in range(3):
                    along = corners[i, end + 1, k] - corners[i, 0, k]
                    p[k] = corners[i, 0, k] + middle * along + LIFT_M * normal[i, k]
                if (_free(room, owner[i], p[0], p[1], p[2], 0.0) >= -COVER_M) == first_seen[i]:
                    low = middle
                else:
                    high = middle
            out[i, end] = high
    return out
