"""Pure numpy geometry for drawing: lines, frusta, quaternions, a sensible first view."""

from __future__ import annotations

import numpy as np
import viser.transforms as vt
from numpy.typing import NDArray

from ecslam.types import Mesh

Array = NDArray[np.float64]
# Lower left and upper right corner of the part of the picture to fill, each axis from -1 to 1.
_SCREEN = np.array([-0.94, -0.94]), np.array([0.94, 0.94])
SAMPLE = 20_000  # faces that tell a mesh's directions
LEVEL_DEG, LEVEL_SHARE, NEARLY_LEVEL_DEG = (40.0, 20.0, 8.0), 0.05, 2.0
WALL = 0.2  # the most that a wall's normal may lean
_PHONE = np.array([-0.94, 0.02]), np.array([0.94, 0.8])
_SPARE = 0.06  # how far what was framed may grow beyond that


def wxyz(c2w: Array) -> Array:
    """Unit quaternions [..., 4] of poses [..., 4, 4]."""
    return np.asarray(vt.SO3.from_matrix(c2w[..., :3, :3]).wxyz)


def rotation_difference_deg(a: Array, b: Array) -> Array:
    """Angle in degrees between the rotations of poses [n, 4, 4]; NaN where either is NaN."""
    r = np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3]
    vee = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], 1)
    return np.asarray(np.degrees(np.arctan2(np.linalg.norm(vee, axis=1), np.trace(r, axis1=1, axis2=2) - 1)))


def polyline(points: Array, most: int = 2000) -> NDArray[np.float32]:
    """[n, 3] -> segments [m, 2, 3] joining successive finite points, thinned to about ``most`` of them."""
    points = points[np.linspace(0, len(points) - 1, min(len(points), most)).round().astype(int)]
    segments = np.stack([points[:-1], points[1:]], 1) if len(points) > 1 else np.zeros((0, 2, 3))
    return segments[np.isfinite(segments).all((1, 2))].astype(np.float32)


def frustum_corners(fov_y: float, aspect: float, scale: float) -> Array:
    """Apex and four image corners [5, 3] of a camera frustum, OpenCV axes, ``scale`` metres deep."""
    h = np.tan(fov_y / 2) * scale
    w = h * aspect
    return np.array([[0, 0, 0], [-w, -h, scale], [w, -h, scale], [w, h, scale], [-w, h, scale]])


FRUSTUM_EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
FRUSTUM_FACES = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]], np.uint32)


def frustum_lines(c2w: Array, fov_y: float, aspect: float, scale: float) -> NDArray[np.float32]:
    """Edges [n * 8, 2, 3] of the frusta of poses [n, 4, 4]."""
    corners = frustum_corners(fov_y, aspect, scale)
    world = np.einsum("nij,kj->nki", c2w[:, :3, :3], corners) + c2w[:, None, :3, 3]
    return np.asarray(world[:, FRUSTUM_EDGES].reshape(-1, 2, 3), np.float32)


def up_direction(c2w: Array) -> Array:
    """World up [3] as the cameras' mean up vector, snapped to an axis that lies within 30 degrees."""
    good = c2w[np.isfinite(c2w).all((1, 2))]
    mean = -good[:, :3, 1].mean(0) if len(good) else np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(mean)
    mean = mean / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    axis = np.zeros(3)
    axis[np.argmax(np.abs(mean))] = np.sign(mean[np.argmax(np.abs(mean))])
    return axis if axis @ mean > np.cos(np.radians(30)) else mean


def rotation_to(up: Array) -> Array:
    """Quaternion [4] that turns +z into the unit vector ``up``."""
    axis = np.cross([0.0, 0.0, 1.0], up)
    if np.linalg.norm(axis) < 1e-9:
        axis = np.array([1.0, 0.0, 0.0])
    axis *= np.arccos(np.clip(up[2], -1, 1)) / np.linalg.norm(axis)
    return np.asarray(vt.SO3.exp(axis).wxyz)


def standing(up: Array, front: Array) -> Array:
    """Quaternion [4] that turns +y into ``up`` and +z into ``front``, unit vectors square to each other."""
    return np.asarray(vt.SO3.from_matrix(np.stack([np.cross(up, front), up, front], 1)).wxyz)


def overview(points: Array, up: Array, side: Array, aspect: float, fov_y: float) -> tuple[Array, Array]:
    """``seen_from`` for ``points`` seen obliquely from above; side: horizontal direction [3] towards the viewer."""
    return seen_from(points, up, 0.62 * side / np.linalg.norm(side) + 0.78 * up, aspect, fov_y)


def seen_from(points: Array, up: Array, back: Array, aspect: float, fov_y: float) -> tuple[Array, Array]:
    """Position and look-at point from which ``points`` [n, 3] fill the picture.

    back: direction [3] from what is seen towards the viewer, not along ``up``; aspect: width over height. On a phone
    (aspect below 0.8) the points fill the upper part, since the controls cover the rest.
    """
    axes, (low, high) = _camera_axes(up, back), _part_to_fill(aspect)
    middle, half, tangent = (high + low) / 2, (high - low) / 2, _tangent(aspect, fov_y)
    seen = points @ axes.T
    centre, distance = (seen.min(0) + seen.max(0)) / 2, 0.1
    for _ in range(4):  # nearer points take more room, so where the middle lies depends on the distance
        local = seen - centre
        reach = np.abs(local[:, :2]) / (tangent * half) + local[:, 2:]
        distance = max(float(reach.max()), 0.1)
        spread = local[:, :2] / (distance - local[:, 2:]).clip(1e-3)
        centre[:2] += (spread.min(0) + spread.max(0)) / 2 * distance
    centre[:2] -= middle * tangent * distance
    return (centre + np.array([0, 0, distance])) @ axes, centre @ axes


def sticks_out(points: Array, up: Array, position: Array, look_at: Array, aspect: float, fov_y: float) -> bool:
    """Whether any of ``points`` [n, 3] lies clearly outside what ``seen_from`` fills, for a view that it has given."""
    local = (points - position) @ _camera_axes(up, position - look_at).T
    low, high = _part_to_fill(aspect)
    seen = local[:, :2] / -local[:, 2:].clip(max=-1e-3) / _tangent(aspect, fov_y)
    return bool(((seen < low - _SPARE) | (seen > high + _SPARE)).any() or local[:, 2].max() > 0)


def _camera_axes(up: Array, back: Array) -> Array:
    """To the right, up and back [3, 3] of a camera that looks against ``back``, as rows."""
    back = back / np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def _part_to_fill(aspect: float) -> tuple[Array, Array]:
    return _PHONE if aspect < 0.8 else _SCREEN


def _tangent(aspect: float, fov_y: float) -> Array:
    """Half the width and half the height [2] of the picture, one unit before the camera."""
    return np.asarray(np.tan(fov_y / 2) * np.array([aspect, 1.0]))


def first_side(c2w: Array, up: Array) -> Array:
    """The horizontal direction [3] from what the first of poses [n, 4, 4] sees back to its camera."""
    back = -c2w[0, :3, 2] if len(c2w) else np.zeros(3)
    back = back - (back @ up) * up
    length = np.linalg.norm(back)
    return np.asarray(back / length if length > 0.1 else np.cross(up, [up[2], up[0], up[1]]))


def best_side(mesh: Mesh, up: Array, before: Array | None = None) -> Array:
    """The horizontal direction [3] from which, looking down obliquely, most of a mesh's front faces are in sight.

    before: the direction chosen last; it stays while it is nearly as good.
    """
    normals = _normals(mesh)
    first = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    angles = np.radians(33.0 + 45.0 * np.arange(8))[:, None]
    sides = np.cos(angles) * first + np.sin(angles) * np.cross(up, first)
    sides = sides if before is None else np.concatenate([before[None], sides])
    area = (normals @ (0.62 * sides + 0.78 * up).T).clip(0).sum(0)
    return np.asarray(sides[0] if before is not None and area[0] > 0.75 * area.max() else sides[np.argmax(area)])


def level(mesh: Mesh, guess: Array) -> Array | None:
    """Which way is up, as unit [3], by what lies level in a mesh: floors, tables, ceilings. None with little of that.

    guess: roughly up; it is kept where it is right to within two degrees.
    """
    normals = _normals(mesh)
    area = np.linalg.norm(normals, axis=1)
    up, near = guess, area > 0
    for angle in LEVEL_DEG:
        along = normals @ up
        near = np.abs(along) > np.cos(np.radians(angle)) * area
        total = (np.sign(along)[:, None] * normals)[near].sum(0)
        length = np.linalg.norm(total)
        if length == 0:
            return None
        up = total / length
    if area[near].sum() < LEVEL_SHARE * area.sum():
        return None
    return guess if up @ guess > np.cos(np.radians(NEARLY_LEVEL_DEG)) else np.asarray(up)


def square_side(mesh: Mesh, up: Array, towards: Array) -> Array:
    """The horizontal direction [3] nearest to ``towards`` [3] that is square to most of a mesh's walls."""
    first = towards - (towards @ up) * up
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    normals = _normals(mesh)
    area = np.linalg.norm(normals, axis=1)
    walls = np.abs(normals @ up) < WALL * area
    # Walls that face each other, or meet in a corner, agree once their angles are taken four times.
    angles = np.arctan2(normals[walls] @ second, normals[walls] @ first)
    turn = np.angle(area[walls] @ np.exp(4j * angles)) / 4
    return np.asarray(np.cos(turn) * first + np.sin(turn) * second)


def _normals(mesh: Mesh) -> Array:
    """Normals [n, 3] of a sample of a mesh's faces, twice as long as each is large."""
    return Mesh(mesh.vertices, mesh.faces[:: max(1, len(mesh.faces) // SAMPLE)]).face_normals()


def distance_to_path(point: Array, path: Array) -> float:
    """How far a point [3] lies from the polyline through path [n, 3]."""
    start, along = path[:-1], np.diff(path, axis=0)
    length = np.maximum((along**2).sum(1), 1e-12)
    share = np.clip(((point - start) * along).sum(1) / length, 0, 1)
    return float(np.linalg.norm(start + share[:, None] * along - point, axis=1).min())


def behind(c2w: Array, up: Array, distance: float = 1.1) -> tuple[Array, Array]:
    """A viewing position just behind and above a camera, and the point it looks at."""
    centre, forward = c2w[:3, 3], c2w[:3, 2]
    return centre - distance * forward + 0.45 * distance * up, centre + 1.5 * forward
