"""Exact pictures of a scene: analytic depth in tiles, then colour with anti-aliased silhouettes.

Every shape is projected to a screen box once a frame; a tile intersects its rays only with the shapes whose box
covers it, nearest first, and stops at the first shape that lies wholly behind what it has found.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...types import Intrinsics
from .scene import HALF, KIND, Scene
from .shapes import BOX
from .solids import FAR, FAST, ONE, ZERO, F, enter, normal, scalar
from .surface import at, face_of, finish, shade, solid
from .workers import spread

BAND, TILE = 16, 64  # rows and columns of a tile, pixels
NEAR_M = 0.02
TONE_STEPS, TONE_MAX = 4096, 4.0


class View(NamedTuple):
    """A scene seen from one pose. rays: float32 [N, 12]: local direction = rays[0:3] u + rays[3:6] v + rays[6:9] (a
    point at z-depth d is origin + d direction), local origin = rays[9:12]. box: int32 [N, 4] u0, u1, v0, v1 on screen.
    order: int64 [n], shapes in view by near depth; near: float32 [N]."""

    rays: NDArray[np.float32]
    box: NDArray[np.int32]
    order: NDArray[np.int64]
    near: NDArray[np.float32]


def tone_curve() -> NDArray[np.uint8]:
    """uint8 [TONE_STEPS] display value of linear light 0..TONE_MAX: gamma 2.2 with a soft shoulder."""
    x = np.linspace(0, TONE_MAX, TONE_STEPS)
    knee = 0.65
    soft = np.where(x < knee, x, knee + (1 - knee) * (1 - np.exp(-(x - knee) / (1 - knee))))
    return np.rint(255 * soft ** (1 / 2.2)).astype(np.uint8)


TONE = tone_curve()


def render(scene: Scene, camera: Intrinsics, c2w: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour uint8 [H, W, 3] and z-depth float32 [H, W] in metres, 0 where nothing is hit, from a pose [4, 4]."""
    numbers, values, texels, light, *_ = scene
    view = _look(scene, camera, c2w)
    depth = np.empty((camera.height, camera.width), np.float32)
    keys = np.empty((camera.height, camera.width), np.int32)
    color = np.zeros((camera.height, camera.width, 3), np.uint8)
    bands = -(-camera.height // BAND)
    pixel = F(1 / camera.fx)
    spread(lambda i: _depth_band(numbers, values, *view, depth, keys, i * BAND), bands)
    spread(
        lambda i: _color_band(numbers, values, texels, light, view.rays, depth, keys, pixel, TONE, i * BAND, color),
        bands,
    )
    return color, depth


def _look(scene: Scene, camera: Intrinsics, c2w: NDArray[np.float64]) -> View:
    """Express the pixel rays in every shape's frame and bound every shape on the screen."""
    back = scene.rotation.transpose(0, 2, 1)
    turn = back @ c2w[:3, :3]
    origin = np.einsum("nij,nj->ni", back, c2w[:3, 3] - scene.center)
    step = (turn @ np.linalg.inv(camera.matrix())).transpose(0, 2, 1).reshape(-1, 9)
    corners = (scene.values[:, None, :3] * _SIGNS - origin[:, None]) @ turn
    box, near = _screen_boxes(corners, camera)
    order = np.argsort(near, kind="stable")
    shown = (near < FAR) & (box[:, 0] < box[:, 1]) & (box[:, 2] < box[:, 3])
    rays = np.concatenate([step, origin], 1).astype(np.float32)
    return View(rays, box, order[shown[order]], near.astype(np.float32))


_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
_EDGES = np.array([(i, j) for i in range(8) for j in range(8) if (_SIGNS[i] != _SIGNS[j]).sum() <= 1])


def _screen_boxes(corners: NDArray[np.float64], camera: Intrinsics) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Pixel boxes int32 [N, 4] (u0, u1, v0, v1, ends exclusive) and near depths of boxes [N, 8, 3] in camera axes.

    Each corner, and where it lies behind the near plane the points where its edges cross that plane, is projected.
    """
    start, end = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
    behind = start[..., 2] < NEAR_M
    gap = end[..., 2] - start[..., 2]
    share = np.where(behind, (NEAR_M - start[..., 2]) / np.where(gap > 0, gap, 1), 0)
    p = start + share[..., None] * (end - start)
    shown = ~behind | (end[..., 2] > NEAR_M)
    z = np.where(shown, p[..., 2], 1.0)
    u = np.where(shown, camera.fx * p[..., 0] / z + camera.cx, np.nan)
    v = np.where(shown, camera.fy * p[..., 1] / z + camera.cy, np.nan)
    low, high = np.fmin.reduce([u, v], -1), np.fmax.reduce([u, v], -1)
    size = np.array([[camera.width], [camera.height]])
    first = np.clip(np.floor(np.nan_to_num(low, nan=1e9)), 0, size)
    last = np.clip(np.ceil(np.nan_to_num(high, nan=-1e9)) + 1, 0, size)
    near = np.where(shown, p[..., 2], np.inf).min(-1)
    return np.stack([first[0], last[0], first[1], last[1]], 1).astype(np.int32), near


@scalar
def _line(rays, k, v):
    """Rays of image row v in the frame of shape k: direction = first three u + next three, origin = last three."""
    k = at(k)
    return (
        *(rays[k, 0], rays[k, 1], rays[k, 2]),
        *(rays[k, 3] * v + rays[k, 6], rays[k, 4] * v + rays[k, 7], rays[k, 5] * v + rays[k, 8]),
        *(rays[k, 9], rays[k, 10], rays[k, 11]),
    )


@scalar
def _box_row(z, ids, y, k, left, x0, x1, ax, ay, az, cx, cy, cz, ox, oy, oz, hx, hy, hz):
    """Intersect one row of rays with a box; no branches, so that it runs in vector registers."""
    lx, ly, lz, rx, ry, rz = -hx - ox, -hy - oy, -hz - oz, hx - ox, hy - oy, hz - oz
    for x in range(x0, x1):
        u = F(left + x)
        ix, iy, iz = ONE / (ax * u + cx), ONE / (ay * u + cy), ONE / (az * u + cz)
        a, b, c, d, e, f = lx * ix, rx * ix, ly * iy, ry * iy, lz * iz, rz * iz
        near = max(max(min(a, b), min(c, d)), min(e, f))
        far = min(min(max(a, b), max(c, d)), max(e, f))
        closer = (near <= far) & (near > ZERO) & (near < z[y, x])
        z[y, x] = near if closer else z[y, x]
        ids[y, x] = k if closer else ids[y, x]


@scalar
def _curved_row(kind, extra, z, ids, y, k, left, x0, x1, ax, ay, az, cx, cy, cz, ox, oy, oz, hx, hy, hz):
    for x in range(x0, x1):
        u = F(left + x)
        t = enter(kind, hx, hy, hz, extra, ox, oy, oz, ax * u + cx, ay * u + cy, az * u + cz)
        if ZERO < t < z[y, x]:
            z[y, x] = t
            ids[y, x] = k


@njit(cache=True, nogil=True)
def _depth_band(numbers, values, rays, boxes, order, nears, depth, keys, top):
    """Fill a band of rows of depth [H, W] and keys int32 [H, W]: 8 shape + face, -1 where nothing is hit."""
    z, ids = np.empty((BAND, TILE), np.float32), np.empty((BAND, TILE), np.int32)
    for left in range(0, depth.shape[1], TILE):
        _tile(numbers, values, rays, boxes, order, nears, depth, keys, top, left, z, ids)


@scalar
def _tile(numbers, values, rays, boxes, order, nears, depth, keys, top, left, z, ids):
    rows, columns = min(BAND, depth.shape[0] - top), min(TILE, depth.shape[1] - left)
    z[:], ids[:] = FAR, -1
    farthest = FAR
    for k in order:
        if nears[k] > farthest:
            break
        x0, x1 = max(boxes[k, 0] - left, 0), min(boxes[k, 1] - left, columns)
        y0, y1 = max(boxes[k, 2] - top, 0), min(boxes[k, 3] - top, rows)
        if x0 >= x1 or y0 >= y1:
            continue
        kind, hx, hy, hz, extra = solid(numbers, values, k)
        shape = np.int32(k)
        for y in range(y0, y1):
            line = _line(rays, k, F(top + y))
            if kind == BOX:
                _box_row(z, ids, y, shape, left, x0, x1, *line, hx, hy, hz)
            else:
                _curved_row(kind, extra, z, ids, y, shape, left, x0, x1, *line, hx, hy, hz)
        farthest = _farthest(z, rows, columns)
    for y in range(rows):
        for x in range(columns):
            k = ids[y, x]
            depth[top + y, left + x] = ZERO
            keys[top + y, left + x] = -1
            if k >= 0:
                depth[top + y, left + x] = z[y, x]
                face = _box_face(values, rays, k, F(left + x), F(top + y), z[y, x]) if numbers[k, KIND] == BOX else 0
                keys[top + y, left + x] = 8 * k + face


@scalar
def _farthest(z, rows, columns):
    out = ZERO
    for y in range(rows):
        for x in range(columns):
            out = max(out, z[y, x])
    return out


@scalar
def _box_face(values, rays, k, u, v, t):
    ax, ay, az, bx, by, bz, ox, oy, oz = _line(rays, k, v)
    px, py, pz = ox + t * (ax * u + bx), oy + t * (ay * u + by), oz + t * (az * u + bz)
    nx, ny, nz = normal(BOX, values[k, HALF], values[k, HALF + 1], values[k, HALF + 2], ZERO, px, py, pz)
    return face_of(nx, ny, nz)


@scalar
def _radiance(numbers, texels, light, form, look, line, u, t, pixel, face):
    """Linear RGB at column u of a row where it meets a shape at depth t; pixel: 1 / focal length.

    face: the face of a box that is hit, or -1 to work it out.
    """
    dx, dy, dz = line[0] * u + line[3], line[1] * u + line[4], line[2] * u + line[5]
    px, py, pz = line[6] + t * dx, line[7] + t * dy, line[8] + t * dz
    if face >= 0:
        along = dx if face < 2 else dy if face < 4 else dz
    else:
        kind, hx, hy, hz, extra = form
        nx, ny, nz = normal(kind, hx, hy, hz, extra, px, py, pz)
        along = dx * nx + dy * ny + dz * nz
        face = face_of(nx, ny, nz)
    square = dx * dx + dy * dy + dz * dz
    wide = t * pixel * t * pixel
    footprint4 = wide * wide * square / max(along * along, F(0.0016) * square)
    return shade(numbers, texels, light, look, px, py, pz, face, footprint4)


@scalar
def _display(tone, light):
    return F(tone[at(min(np.int64(light * F(TONE_STEPS / TONE_MAX)), TONE_STEPS - 1))])


@scalar
def _nearest(numbers, values, rays, candidates, u, v):
    """(shape, depth) of the nearest of five candidate shapes along a ray; shape -1 for none."""
    best, which = FAR, np.int64(-1)
    for i in range(5):
        k = candidates[i]
        if k < 0 or (i > 0 and k == candidates[i - 1]):
            continue
        kind, hx, hy, hz, extra = solid(numbers, values, k)
        ax, ay, az, bx, by, bz, ox, oy, oz = _line(rays, k, v)
        t = enter(kind, hx, hy, hz, extra, ox, oy, oz, ax * u + bx, ay * u + by, az * u + bz)
        if ZERO < t < best:
            best, which = t, k
    return which, best


@scalar
def _edge_pixel(numbers, values, texels, light, rays, candidates, u, v, pixel, tone):
    """Mean of four samples of a pixel in which several faces meet; candidates: five shapes seen in and around it."""
    one, left, right, up, down = candidates
    apart = one != left or one != right or one != up or one != down
    red, green, blue, hits = ZERO, ZERO, ZERO, F(1e-6)
    r, g, b, before = ZERO, ZERO, ZERO, np.int64(-1)
    for i in range(4):
        su, sv = u + F((i & 1 ^ i >> 1) * 0.5 - 0.25), v + F((i >> 1) * 0.5 - 0.25)
        k, t = _nearest(numbers, values, rays, candidates, su, sv)
        if k < 0:
            continue
        if k != before or not apart:
            form, look = solid(numbers, values, k), finish(numbers, values, k)
            r, g, b = _radiance(numbers, texels, light, form, look, _line(rays, k, sv), su, t, pixel, -1)
            r, g, b, before = _display(tone, r), _display(tone, g), _display(tone, b), k
        red, green, blue, hits = red + r, green + g, blue + b, hits + ONE
    return red / hits, green / hits, blue / hits


@scalar
def _inside(key, above, below, x, width):
    """Whether a pixel and its four neighbours show the same face of the same shape (the image's rim counts as same)."""
    here = key[at(x)]
    left, right = key[at(max(x - 1, 0))], key[at(min(x + 1, width - 1))]
    return (above[at(x)] == here) & (below[at(x)] == here) & (left == here) & (right == here)


@scalar
def _run(numbers, values, texels, light, rays, depth, key, start, end, v, pixel, tone, out):
    """Paint pixels start .. end - 1 of row v, all on one face."""
    k, face = np.int64(key[start] >> 3), np.int64(key[start] & 7)
    form, look, line = solid(numbers, values, k), finish(numbers, values, k), _line(rays, k, v)
    if form[0] != BOX:
        face = -1
    for x in range(start, end):
        r, g, b = _radiance(numbers, texels, light, form, look, line, F(x), depth[at(x)], pixel, face)
        i = at(x)
        out[i, 0], out[i, 1], out[i, 2] = _display(tone, r), _display(tone, g), _display(tone, b)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _color_band(numbers, values, texels, light, rays, depth, keys, pixel, tone, top, out):
    height, width = keys.shape
    for y in range(top, min(top + BAND, height)):
        key, above, below = keys[y], keys[max(y - 1, 0)], keys[min(y + 1, height - 1)]
        x = 0
        while x < width:
            start = x
            while x < width and key[x] == key[start] and _inside(key, above, below, x, width):
                x += 1
            if x > start:
                if key[start] >= 0:
                    _run(numbers, values, texels, light, rays, depth[y], key, start, x, F(y), pixel, tone, out[y])
                continue
            left, right = key[max(x - 1, 0)], key[min(x + 1, width - 1)]
            candidates = (key[x] >> 3, left >> 3, right >> 3, above[x] >> 3, below[x] >> 3)
            r, g, b = _edge_pixel(numbers, values, texels, light, rays, candidates, F(x), F(y), pixel, tone)
            out[y, x, 0], out[y, x, 1], out[y, x, 2] = r + F(0.5), g + F(0.5), b + F(0.5)
            x += 1
