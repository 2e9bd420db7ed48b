"""The exact surface of a room as triangles: flat faces as grids, curved solids within 0.3 mm."""

from __future__ import annotations

from collections.abc import Sequence as Many

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...types import Mesh
from .render import TONE, TONE_MAX, TONE_STEPS
from .scene import Scene
from .shapes import BOX, ELLIPSOID, ROUND, Shape
from .solids import F
from .surface import face_of, finish, shade
from .trimming import trim

TOLERANCE_M = 0.00015  # along each of two directions
GRID_M = 0.1
SAME_M = 1e-6

Points = NDArray[np.float64]


def reference_mesh(shapes: Many[Shape], scene: Scene, interior: NDArray[np.float64]) -> Mesh:
    """Triangles of all surfaces inside the box ``interior`` [2, 3], without those that another solid covers.

    Vertices lie on the solids, those of cut triangles on their chords; colours are those of the pictures, averaged over
    a few centimetres.
    """
    parts = [_triangulate(shape) for shape in shapes]
    counts = [len(points) for points, _, _ in parts]
    owner = np.repeat(np.arange(len(shapes)), counts)
    local = np.concatenate([points for points, _, _ in parts])
    up = np.concatenate([normals for _, normals, _ in parts])
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    faces = np.concatenate([f + o for (_, _, f), o in zip(parts, first, strict=True)])
    whole, cut_owner, cut = trim(scene, owner[faces[:, 0]], np.concatenate([local, up], 1)[faces], interior)
    used, compact = np.unique(faces[whole], return_inverse=True)
    extra, extra_faces = _joined(cut_owner, cut)
    owner = np.concatenate([owner[used], extra[:, 0].astype(np.intp)])
    local = np.concatenate([local[used], extra[:, 1:4]])
    up = np.concatenate([up[used], extra[:, 4:]])
    faces = np.concatenate([compact.reshape(-1, 3), extra_faces + len(used)])
    world = np.einsum("nij,nj->ni", scene.rotation[owner], local) + scene.center[owner]
    colors = _colors(*scene[:4], owner, np.float32(local), np.float32(up), F((GRID_M / 2) ** 4), TONE)
    return Mesh(np.float32(world), faces.astype(np.int32), colors)


def _joined(owner: NDArray[np.intp], corners: Points) -> tuple[Points, NDArray[np.intp]]:
    """Triangles [P, 3, 6] with shared vertices: rows [V, 7] of owner, point and normal, and faces [P, 3]."""
    rows = np.concatenate([np.repeat(owner, 3)[:, None], corners.reshape(-1, 6)], 1)
    _, first, faces = np.unique(
        (rows / SAME_M).round().astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    return rows[first], faces.reshape(-1, 3)


def _triangulate(shape: Shape) -> tuple[Points, Points, NDArray[np.intp]]:
    """Local points and normals [V, 3] and triangles [F, 3], counter-clockwise from outside."""
    if shape.kind == BOX:
        return _box(np.array(shape.half))
    rows = _rows(shape)
    points = rows.reshape(-1, 3)
    count, across = rows.shape[:2]
    i, j = np.mgrid[0 : count - 1, 0:across]
    a, b = i * across + j, i * across + (j + 1) % across
    faces = np.concatenate([np.stack([a, b, b + across], -1), np.stack([a, b + across, a + across], -1)]).reshape(-1, 3)
    return points, Mesh(points.astype(np.float32), faces.astype(np.int32)).vertex_normals(), faces


def _box(half: Points) -> tuple[Points, Points, NDArray[np.intp]]:
    points, normals, faces, total = [], [], [], 0
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        nu, nv = (max(1, int(np.ceil(2 * half[k] / GRID_M))) for k in (u, v))
        a, b = np.meshgrid(
            np.linspace(-half[u], half[u], nu + 1), np.linspace(-half[v], half[v], nv + 1), indexing="ij"
        )
        i, j = np.mgrid[0:nu, 0:nv]
        p = (i * (nv + 1) + j).ravel()
        q = p + nv + 1
        quads = np.concatenate([np.stack([p, q, q + 1], -1), np.stack([p, q + 1, p + 1], -1)])
        for side in (-1, 1):
            face = np.zeros((a.size, 3))
            face[:, axis], face[:, u], face[:, v] = side * half[axis], a.ravel(), b.ravel()
            points.append(face)
            normals.append(np.tile(np.eye(3)[axis] * side, (a.size, 1)))
            faces.append((quads if side > 0 else quads[:, ::-1]) + total)
            total += a.size
    return np.concatenate(points), np.concatenate(normals), np.concatenate(faces)


def _rows(shape: Shape) -> Points:
    """A curved solid as outlines [R, C, 3], counter-clockwise, stacked from its bottom's centre to its top's."""
    hx, hy, hz = shape.half
    if shape.kind == ELLIPSOID:
        segments = _segments(max(shape.half), 2 * np.pi)
        ring = _ring(np.linspace(0, 2 * np.pi, segments, endpoint=False))
        tilt = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)[:, None]
        flat = np.cos(tilt)[..., None] * ring * [hx, hy]
        return np.concatenate([flat, np.broadcast_to(hz * np.sin(tilt)[..., None], (*flat.shape[:2], 1))], -1)
    if shape.kind == ROUND:
        return _round_rows(shape)
    ring = _ring(np.linspace(0, 2 * np.pi, _segments(hx, 2 * np.pi), endpoint=False))
    z = np.linspace(-hz, hz, max(2, int(np.ceil(2 * hz / GRID_M)) + 1))
    radius = hx - abs(shape.extra) * hz + shape.extra * z
    side = np.concatenate([radius[:, None, None] * ring, np.broadcast_to(z[:, None, None], (len(z), len(ring), 1))], -1)
    return _capped(side)


def _round_rows(shape: Shape) -> Points:
    """Outlines of a rounded box: rounded rectangles whose corner radius shrinks towards top and bottom."""
    r = shape.extra
    cx, cy, cz = (max(h - r, 0.0) for h in shape.half)
    steps = _segments(r, np.pi / 2)
    arc = np.linspace(0, np.pi / 2, steps + 1)
    corners = [(cx, cy), (-cx, cy), (-cx, -cy), (cx, -cy)]
    core, spread = [], []
    for k, corner in enumerate(corners):
        following = corners[(k + 1) % 4]
        core += [corner] * (steps + 1)
        spread += list(_ring(arc + k * np.pi / 2))
        between = int(np.ceil(np.hypot(following[0] - corner[0], following[1] - corner[1]) / GRID_M))
        for s in np.arange(1, between) / max(between, 1):
            core.append((corner[0] + s * (following[0] - corner[0]), corner[1] + s * (following[1] - corner[1])))
            spread.append(spread[-1])
    tilt = np.concatenate([arc - np.pi / 2, arc])
    level = np.repeat([-cz, cz], steps + 1)
    middle = int(np.ceil(2 * cz / GRID_M))
    if middle > 1:
        tilt = np.insert(tilt, steps + 1, np.zeros(middle - 1))
        level = np.insert(level, steps + 1, -cz + 2 * cz * np.arange(1, middle) / middle)
    flat = np.array(core) + r * np.cos(tilt)[:, None, None] * np.array(spread)
    z = level + r * np.sin(tilt)
    return _capped(np.concatenate([flat, np.broadcast_to(z[:, None, None], (*flat.shape[:2], 1))], -1))


def _capped(side: Points) -> Points:
    """Close the first and last outline with smaller and smaller copies down to their centres."""

    def cap(edge: Points) -> Points:
        count = max(1, int(np.ceil(np.abs(edge[:, :2]).max() / GRID_M)))
        return edge[None] * np.stack([s := np.arange(count) / count, s, np.ones(count)], -1)[:, None]

    return np.concatenate([cap(side[0]), side, cap(side[-1])[::-1]])


def _ring(angles: Points) -> Points:
    return np.stack([np.cos(angles), np.sin(angles)], -1)


def _segments(radius: float, angle: float) -> int:
    """Into how many chords an arc must be cut to stay within TOLERANCE_M."""
    if radius <= TOLERANCE_M:
        return 1 if angle < np.pi else 6
    chord = 2 * np.arccos(1 - TOLERANCE_M / radius)
    count = int(np.ceil(angle / chord))
    return max(count, 2) if angle < np.pi else max(8, count + count % 2)


@njit(cache=True, nogil=True)
def _colors(numbers, values, texels, light, owner, points, normals, footprint4, tone):
    """uint8 [V, 3] colours of surface points [V, 3] given in the frames of their shapes."""
    out = np.empty((len(points), 3), np.uint8)
    for i in range(len(points)):
        look = finish(numbers, values, owner[i])
        face = face_of(normals[i, 0], normals[i, 1], normals[i, 2])
        rgb = shade(numbers, texels, light, look, points[i, 0], points[i, 1], points[i, 2], face, footprint4)
        out[i, 0] = tone[min(int(rgb[0] * F(TONE_STEPS / TONE_MAX)), TONE_STEPS - 1)]
        out[i, 1] = tone[min(int(rgb[1] * F(TONE_STEPS / TONE_MAX)), TONE_STEPS - 1)]
        out[i, 2] = tone[min(int(rgb[2] * F(TONE_STEPS / TONE_MAX)), TONE_STEPS - 1)]
    return out
