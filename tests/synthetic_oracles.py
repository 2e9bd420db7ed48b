"""Independent arithmetic for the synthetic rooms: signed distances in numpy, float64, and sphere tracing on them."""

import numpy as np

from ecslam.datasets.synthetic.shapes import BOX, ELLIPSOID, ROUND


def distances(shapes, points):
    """[P] distance to the nearest surface, negative inside a solid (ellipsoids: a lower bound, exact near 0)."""
    best = np.full(len(points), np.inf)
    for shape in shapes:
        best = np.minimum(best, distance(shape, points))
    return best


def on_surface(shapes, points):
    """[P] distance to the nearest surface, from either side."""
    best = np.full(len(points), np.inf)
    for shape in shapes:
        best = np.minimum(best, np.abs(distance(shape, points)))
    return best


def distance(shape, points):
    p = (points - shape.center) @ shape.rotation
    half = np.array(shape.half)
    if shape.kind == BOX:
        return _box(np.abs(p) - half)
    if shape.kind == ROUND:
        return _box(np.abs(p) - half + shape.extra) - shape.extra
    if shape.kind == ELLIPSOID:
        scaled, steep = np.linalg.norm(p / half, axis=1), np.linalg.norm(p / half**2, axis=1)
        near = scaled * (scaled - 1) / np.maximum(steep, 1e-12)
        return np.where(near > 0, np.maximum(near, _box(np.abs(p) - half)), near)
    radius = np.hypot(p[:, 0], p[:, 1])
    wide = half[0] - abs(shape.extra) * half[2] + shape.extra * p[:, 2]
    return np.maximum((radius - wide) / np.hypot(1, shape.extra), np.abs(p[:, 2]) - half[2])


def _box(q):
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)


def sphere_trace(shapes, origins, directions, steps=400):
    """[R] distance along unit directions to the first surface; NaN where it is not found (a grazing ray)."""
    t = np.zeros(len(origins))
    for _ in range(steps):
        t += 0.5 * np.maximum(distances(shapes, origins + t[:, None] * directions), 0)
    close = np.abs(distances(shapes, origins + t[:, None] * directions)) < 1e-5
    return np.where(close, t, np.nan)


def rays(camera, c2w):
    """World directions [H, W, 3] of the pixels, one metre deep along the optical axis."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    return local @ c2w[:3, :3].T


def points_of(camera, frame):
    """World points [H, W, 3] of a frame."""
    return frame.c2w_gt[:3, 3] + frame.depth.astype(np.float64)[..., None] * rays(camera, frame.c2w_gt)


def look_up(camera, frame, points):
    """Points [P, 3] seen from a frame: (inside the image, their z-depth, measured depth, colour [P, 3]), bilinear."""
    local = (points - frame.c2w_gt[:3, 3]) @ frame.c2w_gt[:3, :3]
    z = np.maximum(local[:, 2], 1e-9)
    u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
    inside = (local[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < camera.width - 1) & (v < camera.height - 1)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    i, j = u.astype(int), v.astype(int)
    a, b = (u - i)[:, None], (v - j)[:, None]
    image = np.concatenate([frame.color.astype(np.float64), frame.depth[..., None].astype(np.float64)], -1)
    top = image[j, i] * (1 - a) + image[j, i + 1] * a
    bottom = image[j + 1, i] * (1 - a) + image[j + 1, i + 1] * a
    found = top * (1 - b) + bottom * b
    return inside, local[:, 2], found[:, 3], found[:, :3]
