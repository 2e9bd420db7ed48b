"""A picture of a room from outside and above: walls and ceilings that would be in the way are left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels.raster import rasterize
from ..rigid import inverse
from ..types import Intrinsics, Mesh
from .surface import part

ELEVATION_DEG = 42.0
FOCAL_HEIGHTS = 1.9
SUPERSAMPLING = 2

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Picture:
    """rgba: float64 [H, W, 4] in 0..1. depth: float32 [H, W], metres, 0 = background. Taken with camera at c2w."""

    rgba: Floats
    depth: NDArray[np.float32]
    camera: Intrinsics
    c2w: Floats


def dollhouse(mesh: Mesh, poses: Floats, up: Floats, width: int, height: int) -> Picture:
    """Look into the mesh from a corner above it.

    poses: [N, 4, 4], finite: what faces none of these cameras is not drawn, and nothing is drawn from its back, so one
    sees through the near walls and the ceiling. up: unit vector [3].
    """
    mesh = part(mesh, _faces_a_camera(mesh, poses[:: max(1, len(poses) // 60), :3, 3]))
    scale = SUPERSAMPLING
    focal = scale * FOCAL_HEIGHTS * height
    large = Intrinsics(focal, focal, scale * width / 2 - 0.5, scale * height / 2 - 0.5, scale * width, scale * height)
    small = large.resized(width // 8, height // 8)
    c2w = max(_corner_views(mesh, up, large), key=lambda pose: _shown(mesh, small, pose))
    depth, face = rasterize(mesh, large, c2w, front_only=True)
    rgba = _shade(mesh, large, c2w, depth, face, up)
    fine = rgba.reshape(height, scale, width, scale, 4)
    alpha = fine[..., 3:].mean((1, 3))
    color = (fine[..., :3] * fine[..., 3:]).mean((1, 3)) / np.maximum(alpha, 1e-9)
    return Picture(np.concatenate([color, alpha], -1), depth[::scale, ::scale], large.resized(width, height), c2w)


def visible_pixels(picture: Picture, points: Floats, tolerance_m: float = 0.05) -> Floats:
    """Pixels [N, 2] of points [N, 3], NaN where something in the picture hides them."""
    w2c, camera = inverse(picture.c2w), picture.camera
    x, y, z = (points @ w2c[:3, :3].T + w2c[:3, 3]).T
    pixels = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    column, row = np.clip(np.rint(pixels).astype(np.int64), 0, [camera.width - 1, camera.height - 1]).T
    front = picture.depth[row, column]
    pixels[(front > 0) & (z > front + tolerance_m)] = np.nan
    return pixels


def floor_plan(up: Floats) -> Floats:
    """Two level unit vectors [2, 3], right and up on a map seen from above; the world's x and y where z is up."""
    east = np.eye(3)[0 if abs(up[0]) < 0.7 else 1]
    east = east - up * (up @ east)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east)])


def _faces_a_camera(mesh: Mesh, centres: Floats) -> NDArray[np.bool_]:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    offset = (normal * a).sum(1)
    return np.asarray((normal @ centres.T.astype(np.float32) > offset[:, None]).any(1))


def _corner_views(mesh: Mesh, up: Floats, camera: Intrinsics) -> list[Floats]:
    """Poses that look along the four diagonals of the mesh's floor plan and show all of it."""
    plan = floor_plan(up)
    angles = np.radians(np.arange(0, 90, 3))
    turned = np.stack([np.cos(angles), np.sin(angles), -np.sin(angles), np.cos(angles)], -1).reshape(-1, 2, 2) @ plan
    points = mesh.vertices[:: max(1, len(mesh.vertices) // 5000)].astype(np.float64)
    extent = [np.prod(np.ptp(points @ axes.T, axis=0)) for axes in turned]
    axes = turned[int(np.argmin(extent))]
    tilt = np.radians(ELEVATION_DEG)
    views = []
    for diagonal in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        level = np.array(diagonal) @ axes / np.sqrt(2)
        z = np.cos(tilt) * level - np.sin(tilt) * up
        x = np.cross(-up, z) / np.cos(tilt)
        views.append(_fitted(points, np.stack([x, np.cross(z, x), z], 1), camera))
    return views


def _fitted(points: Floats, rotation: Floats, camera: Intrinsics, margin: float = 0.04) -> Floats:
    """A pose with this rotation whose image just holds the points [N, 3] (but for stragglers) in its middle."""
    local = points @ rotation
    low, high = np.quantile(local, [0.001, 0.999], axis=0)
    local = local.clip(low, high)
    centre = (low + high) / 2
    reach = (1 - 2 * margin) * np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2
    for _ in range(4):
        offset = local - centre
        back = (np.abs(offset[:, :2]) / reach - offset[:, 2:]).max()
        seen = offset[:, :2] / (offset[:, 2:] + back)
        centre[:2] += (seen.max(0) + seen.min(0)) / 2 * (back + np.median(offset[:, 2]))
    offset = local - centre
    back = (np.abs(offset[:, :2]) / reach - offset[:, 2:]).max()
    c2w = np.eye(4)
    c2w[:3, :3], c2w[:3, 3] = rotation, rotation @ (centre - [0, 0, back])
    return c2w


def _shown(mesh: Mesh, camera: Intrinsics, c2w: Floats) -> float:
    """How much surface is in sight; a view onto clutter nearby shows little."""
    return float((rasterize(mesh, camera, c2w, front_only=True)[0] ** 2).sum()) / camera.fx**2


def _shade(
    mesh: Mesh, camera: Intrinsics, c2w: Floats, depth: NDArray[np.float32], face: NDArray[np.int32], up: Floats
) -> Floats:
    """rgba [H, W, 4]: vertex colours under light from above and from the viewer, corners a little darker."""
    row, column = np.nonzero(face >= 0)
    corners = mesh.faces[face[row, column]]
    z = depth[row, column].astype(np.float64)
    local = np.stack([(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z], -1)
    weights = _barycentric(mesh.vertices[corners].astype(np.float64), local @ c2w[:3, :3].T + c2w[:3, 3])
    colors = np.full((len(mesh.vertices), 3), 0.82) if mesh.colors is None else mesh.colors / 255
    normal = np.einsum("nk,nkc->nc", weights, mesh.vertex_normals()[corners])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    light = 0.62 + 0.20 * (normal @ up) + 0.28 * np.abs(normal @ c2w[:3, 2])
    rgba = np.zeros((*face.shape, 4))
    rgba[row, column, :3] = np.clip(np.einsum("nk,nkc->nc", weights, colors[corners]) * light[:, None], 0, 1)
    rgba[row, column, 3] = 1
    return rgba


def _barycentric(corners: Floats, points: Floats) -> Floats:
    """Weights [N, 3] of points [N, 3] in their triangles [N, 3, 3]."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    square = np.maximum((normal**2).sum(1), 1e-30)
    v = (np.cross(points - a, c - a) * normal).sum(1) / square
    w = (np.cross(b - a, points - a) * normal).sum(1) / square
    return np.clip(np.stack([1 - v - w, v, w], -1), 0, 1)
