"""Depth of a triangle mesh seen by a pinhole camera: a z-buffer over exact ray-triangle intersections (numba).

The edge functions of a triangle are linear in the pixel and come straight from its corners in camera coordinates (Olano
and Greer 1997), so nothing is clipped, triangles that pass the camera are right, and neighbours leave no gap. The loops
release the interpreter's lock: several views run at once in plain Python threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..se3 import inverse
from ..types import Intrinsics, Mesh


def rasterize(
    mesh: Mesh, intrinsics: Intrinsics, c2w: NDArray[np.float64], *, near_m: float = 0.01, front_only: bool = False
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Depth float32 [H, W] (metres along the optical axis, 0 where nothing is) and face number int32 [H, W] (or -1).

    c2w: [4, 4], OpenCV camera. Both sides of a face are seen unless front_only, which shows only faces that are
    counter-clockwise from the camera. Lens distortion is not applied. Surfaces nearer than near_m are invisible.
    """
    depth = np.full((intrinsics.height, intrinsics.width), np.inf, np.float32)
    face = np.full(depth.shape, -1, np.int32)
    if len(mesh.faces):
        vertices = np.ascontiguousarray(mesh.vertices, np.float32)
        faces = np.ascontiguousarray(mesh.faces, np.int32)
        _rasterize(vertices, faces, _w2c(c2w), _numbers(intrinsics), near_m, front_only, depth, face)
    depth[face < 0] = 0
    return depth, face


def in_sight(
    points: NDArray[np.float32],
    margins_m: NDArray[np.float32],
    intrinsics: Intrinsics,
    c2w: NDArray[np.float64],
    depth: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """bool [N]: which points [N, 3] project into the image with z <= depth + margin at the nearest pixel.

    margins_m: [N]. c2w: [4, 4]. depth: [H, W], metres, 0 = none, where no point is in sight.
    """
    hit = np.zeros(len(points), np.bool_)
    _in_sight(points, margins_m, _w2c(c2w), _numbers(intrinsics), np.ascontiguousarray(depth, np.float32), hit)
    return hit


def _w2c(c2w: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.ascontiguousarray(inverse(np.asarray(c2w, np.float64)))


def _numbers(intrinsics: Intrinsics) -> tuple[float, float, float, float]:
    return float(intrinsics.fx), float(intrinsics.fy), float(intrinsics.cx), float(intrinsics.cy)


@njit(nogil=True, cache=True)
def _rasterize(vertices, faces, w2c, camera, near, front_only, depth, face):
    points, pixels, outside = _project(vertices, w2c, camera, near, depth.shape)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if outside[a] & outside[b] & outside[c] == 0:
            _draw(points, pixels, a, b, c, f, camera, near, front_only, depth, face)


@njit(nogil=True, cache=True)
def _project(vertices, w2c, camera, near, shape):
    """Camera coordinates, pixels (only beyond the near plane), and which of five frustum planes a vertex is beyond."""
    count = vertices.shape[0]
    points = np.empty((count, 3), np.float64)
    pixels = np.empty((count, 2), np.float32)
    outside = np.empty(count, np.uint8)
    fx, fy, cx, cy = camera
    height, width = shape
    for i in range(count):
        for r in range(3):
            points[i, r] = (
                w2c[r, 0] * vertices[i, 0] + w2c[r, 1] * vertices[i, 1] + w2c[r, 2] * vertices[i, 2] + w2c[r, 3]
            )
        z = points[i, 2]
        u, v = fx * points[i, 0] + cx * z, fy * points[i, 1] + cy * z
        outside[i] = (z <= near) + 2 * (u < -z) + 4 * (u > width * z) + 8 * (v < -z) + 16 * (v > height * z)
        if z > near:
            pixels[i, 0], pixels[i, 1] = u / z, v / z
    return points, pixels, outside


@njit(nogil=True, cache=True)
def _draw(points, pixels, a, b, c, number, camera, near, front_only, depth, face):
    height, width = depth.shape
    za, zb, zc = points[a, 2], points[b, 2], points[c, 2]
    if min(za, zb, zc) > near:
        left = min(pixels[a, 0], pixels[b, 0], pixels[c, 0])
        right = max(pixels[a, 0], pixels[b, 0], pixels[c, 0])
        top = min(pixels[a, 1], pixels[b, 1], pixels[c, 1])
        bottom = max(pixels[a, 1], pixels[b, 1], pixels[c, 1])
    else:
        left, right, top, bottom = _extent_in_front(points, (a, b, c), camera, near)
    # A hundredth of a pixel to spare: rounding must not lose a pixel centre on the outline.
    x0, x1 = int(max(0.0, np.ceil(left - 0.01))), int(min(width - 1.0, np.floor(right + 0.01)))
    y0, y1 = int(max(0.0, np.ceil(top - 0.01))), int(min(height - 1.0, np.floor(bottom + 0.01)))
    if x0 > x1 or y0 > y1:
        return
    # Rows of the inverse of [va vb vc], times its determinant: the edge functions over the ray direction.
    ax, ay, az = _cross(points, b, c)
    bx, by, bz = _cross(points, c, a)
    gx, gy, gz = _cross(points, a, b)
    volume = points[a, 0] * ax + points[a, 1] * ay + points[a, 2] * az
    if volume == 0 or (front_only and volume > 0):
        return
    if volume < 0:
        volume, ax, ay, az, bx, by, bz, gx, gy, gz = -volume, -ax, -ay, -az, -bx, -by, -bz, -gx, -gy, -gz
    fx, fy, cx, cy = camera
    ax, bx, gx = ax / fx, bx / fx, gx / fx
    for y in range(y0, y1 + 1):
        dy = (y - cy) / fy
        ra, rb, rg = dy * ay + az, dy * by + bz, dy * gy + gz
        for x in range(x0, x1 + 1):
            dx = x - cx
            ea, eb, eg = dx * ax + ra, dx * bx + rb, dx * gx + rg
            if ea >= 0 and eb >= 0 and eg >= 0 and ea + eb + eg > 0:
                z = volume / (ea + eb + eg)
                if near < z < depth[y, x]:
                    depth[y, x] = z
                    face[y, x] = number


@njit(nogil=True, cache=True)
def _extent_in_front(points, corners, camera, near):
    """Pixel bounds of the part of a triangle beyond the near plane, which cuts it."""
    fx, fy, cx, cy = camera
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for k in range(3):
        i, j = corners[k], corners[(k + 1) % 3]
        for end in range(2):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            if end == 1:
                if (z > near) == (points[j, 2] > near):
                    continue
                share = (near - z) / (points[j, 2] - z)
                x, y, z = x + share * (points[j, 0] - x), y + share * (points[j, 1] - y), near
            elif z <= near:
                continue
            left, right = min(left, fx * x / z + cx), max(right, fx * x / z + cx)
            top, bottom = min(top, fy * y / z + cy), max(bottom, fy * y / z + cy)
    return left, right, top, bottom


@njit(nogil=True, cache=True, inline="always")
def _cross(points, i, j):
    return (
        points[i, 1] * points[j, 2] - points[i, 2] * points[j, 1],
        points[i, 2] * points[j, 0] - points[i, 0] * points[j, 2],
        points[i, 0] * points[j, 1] - points[i, 1] * points[j, 0],
    )


@njit(nogil=True, cache=True)
def _in_sight(points, margins, w2c, camera, depth, hit):
    fx, fy, cx, cy = camera
    height, width = depth.shape
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        z = w2c[2, 0] * px + w2c[2, 1] * py + w2c[2, 2] * pz + w2c[2, 3]
        if z <= 0:
            continue
        x = w2c[0, 0] * px + w2c[0, 1] * py + w2c[0, 2] * pz + w2c[0, 3]
        y = w2c[1, 0] * px + w2c[1, 1] * py + w2c[1, 2] * pz + w2c[1, 3]
        u, v = fx * x / z + cx, fy * y / z + cy
        if 0 <= u <= width - 1 and 0 <= v <= height - 1:
            measured = depth[int(v + 0.5), int(u + 0.5)]
            hit[i] = measured > 0 and z <= measured + margins[i]
