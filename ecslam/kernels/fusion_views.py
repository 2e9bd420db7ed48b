"""Averaging a view into the fused TSDF volume (numba): which blocks it touches, and what their voxels become."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .fusion import BITS, CELLS, EDGE, EMPTY, HALF, INLINE, MASK, OPTIONS, SCALE, block_key, slot_of

MAX_WEIGHT = 200
WEIGHT_STEPS = 8.0
NORMAL_BASELINE_M = 0.03
NORMAL_STRIDE = 2
NEAREST_M = 0.05
NOWHERE_M = np.float32(1e9)


class View(NamedTuple):
    """One depth image. depth: float32 [H, W] metres, 0 = none. light: float32 [H, W] in 0..1. normal: float32
    [H / 2, W / 2, 3] in the camera. camera: fx, fy, cx, cy. c2w: float64 [4, 4]. sweep: the camera's motion from
    the first row to the last, translation and rotation vector in its own coordinates; c2w is the pose halfway."""

    depth: NDArray[np.float32]
    light: NDArray[np.float32]
    normal: NDArray[np.float32]
    camera: tuple[float, float, float, float]
    c2w: NDArray[np.float64]
    sweep: tuple[float, float, float, float, float, float]


@njit(**INLINE)
def drift(sweep, x, y, z):
    """How a point in the camera's coordinates moves during a sweep, as a camera that turns and goes on sees it."""
    t0, t1, t2, w0, w1, w2 = sweep
    return t0 + w1 * z - w2 * y, t1 + w2 * x - w0 * z, t2 + w0 * y - w1 * x


@njit(**OPTIONS)
def touch(blocks, used, view, stride, reach, voxel, stamp, now, out):
    """Make and list the blocks within ``reach`` metres of the measured surface along every ``stride``-th pixel.

    Returns how many blocks there are now and how many are listed in ``out``; (used, -1) when there is no more room:
    make some and call again.
    """
    fx, fy, cx, cy = view.camera
    m = view.c2w
    height, width = view.depth.shape
    edge = voxel * EDGE
    listed = 0
    steps = int(np.ceil(2 * reach / (0.5 * edge))) + 1
    last = EMPTY
    for v in range(stride // 2, height, stride):
        for u in range(stride // 2, width, stride):
            d = view.depth[v, u]
            if d <= 0:
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            share = (v + 0.5) / height - 0.5
            dx, dy, dz = drift(view.sweep, x * d, y * d, d)
            for step in range(steps):
                z = d - reach + 2 * reach * step / (steps - 1)
                a, b, c = x * z + share * dx, y * z + share * dy, z + share * dz
                i = np.floor((m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]) / edge)
                j = np.floor((m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]) / edge)
                k = np.floor((m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]) / edge)
                key = block_key(i, j, k)
                if key == last:
                    continue
                last = key
                slot = slot_of(blocks.keys, key)
                if blocks.keys[slot] == EMPTY:
                    if used == blocks.place.size or listed == out.size:
                        return used, -1
                    blocks.keys[slot] = key
                    blocks.row[slot] = used
                    blocks.place[used] = key
                    used += 1
                row = blocks.row[slot]
                if stamp[row] != now:
                    if listed == out.size:
                        return used, -1
                    stamp[row] = now
                    out[listed] = row
                    listed += 1
    return used, listed


@njit(**OPTIONS)
def normals(depth, camera, out, first, last):
    """Unit normals towards the camera into the rows ``first`` to ``last`` of ``out``, from central differences over a
    baseline of about three centimetres; across a depth edge, the viewing direction."""
    fx, fy, cx, cy = camera
    height, width = depth.shape
    for i in range(first, last):
        v = i * NORMAL_STRIDE
        for j in range(out.shape[1]):
            u = j * NORMAL_STRIDE
            d = depth[v, u]
            x, y = (u - cx) / fx, (v - cy) / fy
            scale = -1.0 / np.sqrt(x * x + y * y + 1)
            n0, n1, n2 = scale * x, scale * y, scale
            if d > 0:
                k = max(1, int(NORMAL_BASELINE_M * fx / d))
                if u >= k and v >= k and u + k < width and v + k < height:
                    left, right, up, down = depth[v, u - k], depth[v, u + k], depth[v - k, u], depth[v + k, u]
                    bend = 0.01 + 0.01 * d
                    if (
                        left > 0
                        and right > 0
                        and up > 0
                        and down > 0
                        and abs(left + right - 2 * d) < bend
                        and abs(up + down - 2 * d) < bend
                    ):
                        a0 = (u + k - cx) / fx * right - (u - k - cx) / fx * left
                        a1, a2 = y * (right - left), right - left
                        b0 = x * (down - up)
                        b1 = (v + k - cy) / fy * down - (v - k - cy) / fy * up
                        b2 = down - up
                        c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
                        norm = np.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
                        if norm > 1e-12:
                            sign = -1.0 / norm if c0 * x + c1 * y + c2 > 0 else 1.0 / norm
                            n0, n1, n2 = sign * c0, sign * c1, sign * c2
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = n0, n1, n2


class Cells(NamedTuple):
    """Room for what is worked out of the voxels of one block, x fastest.

    spot: float32 [3, 512], where they lie in the camera; ``NOWHERE_M`` deep outside the image. ray: float32 [2, 512],
    through the pixel that sees them. pixel, slope: uint32 [512], where that is in an image and among the normals. seen:
    uint32 [513], those a view may change, from the first place on. depth: float32 [512]; found: float32 [4, 512],
    luminance and normal in that pixel. held: float32 [3, 512], the voxels themselves.
    """

    spot: NDArray[np.float32]
    ray: NDArray[np.float32]
    pixel: NDArray[np.uint32]
    slope: NDArray[np.uint32]
    seen: NDArray[np.uint32]
    depth: NDArray[np.float32]
    found: NDArray[np.float32]
    held: NDArray[np.float32]


@njit(**INLINE)
def project(key, voxel, view, cells):
    """Fill ``spot``, ``ray``, ``pixel`` and ``slope`` of a block's voxels, seen when the row that sees them is read.
    The block's corner is placed in float64. Without branches, so that it is done for several voxels at once."""
    f = np.float32
    fx, fy, cx, cy = f(view.camera[0]), f(view.camera[1]), f(view.camera[2]), f(view.camera[3])
    rows, columns = np.int32(view.depth.shape[0]), np.int32(view.depth.shape[1])
    height, width, slopes = f(rows), f(columns), np.int32(view.normal.shape[1])
    s = view.sweep
    sweep = (f(s[0]), f(s[1]), f(s[2]), f(s[3]), f(s[4]), f(s[5]))
    moving = (abs(s[0]) + abs(s[1]) + abs(s[2]) + abs(s[3]) + abs(s[4]) + abs(s[5])) > 0
    m = view.c2w
    bx = ((key >> (2 * BITS)) - HALF) * EDGE * voxel - m[0, 3]
    by = (((key >> BITS) & MASK) - HALF) * EDGE * voxel - m[1, 3]
    bz = ((key & MASK) - HALF) * EDGE * voxel - m[2, 3]
    x0 = f(m[0, 0] * bx + m[1, 0] * by + m[2, 0] * bz)
    y0 = f(m[0, 1] * bx + m[1, 1] * by + m[2, 1] * bz)
    z0 = f(m[0, 2] * bx + m[1, 2] * by + m[2, 2] * bz)
    xi, xj, xk = f(m[0, 0] * voxel), f(m[1, 0] * voxel), f(m[2, 0] * voxel)
    yi, yj, yk = f(m[0, 1] * voxel), f(m[1, 1] * voxel), f(m[2, 1] * voxel)
    zi, zj, zk = f(m[0, 2] * voxel), f(m[1, 2] * voxel), f(m[2, 2] * voxel)
    near, half, across, down = f(NEAREST_M), f(0.5), f(1 / view.camera[0]), f(1 / view.camera[1])
    for cell in range(CELLS):
        i, j, k = f(cell & 7), f((cell >> 3) & 7), f(cell >> 6)
        x, y, z = x0 + xi * i + xj * j + xk * k, y0 + yi * i + yj * j + yk * k, z0 + zi * i + zj * j + zk * k
        if moving:
            share = min(max((fy * y / max(z, near) + cy + half) / height - half, -half), half)
            dx, dy, dz = drift(sweep, x, y, z)
            x, y, z = x - share * dx, y - share * dy, z - share * dz
        scale = f(1) / max(z, near)
        u, v = np.floor(fx * x * scale + cx + half), np.floor(fy * y * scale + cy + half)
        inside = (z > near) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        column, row = np.int32(u) if inside else np.int32(0), np.int32(v) if inside else np.int32(0)
        cells.spot[0, cell], cells.spot[1, cell], cells.spot[2, cell] = x, y, z if inside else NOWHERE_M
        cells.ray[0, cell], cells.ray[1, cell] = (u - cx) * across, (v - cy) * down
        cells.pixel[cell] = row * columns + column
        cells.slope[cell] = row // NORMAL_STRIDE * slopes + column // NORMAL_STRIDE


@njit(**INLINE)
def fetch(voxels, view, behind, cells):
    """How many of a block's voxels lie at most ``behind`` metres behind what is measured; lists them, and fills
    ``depth``, ``found`` and ``held`` there."""
    depth, light, normal = view.depth.reshape(-1), view.light.reshape(-1), view.normal.reshape(-1, 3)
    found, held, count = cells.found, cells.held, 0
    for cell in range(CELLS):
        d = depth[cells.pixel[cell]]
        cells.depth[cell] = d
        cells.seen[count] = cell
        count += (d > 0) & (d >= cells.spot[2, cell] - behind)
    for n in range(count):
        cell = cells.seen[n]
        at = cells.slope[cell]
        found[0, cell] = light[cells.pixel[cell]]
        found[1, cell], found[2, cell], found[3, cell] = normal[at, 0], normal[at, 1], normal[at, 2]
        held[0, cell], held[1, cell], held[2, cell] = voxels[cell, 0], voxels[cell, 1], voxels[cell, 2]
    return count


@njit(**INLINE)
def average(cells, truncation):
    """``held`` after the view: running averages of the distance to the tangent plane of the measured surface (cut off
    at the truncation) and of the luminance near it. Of all voxels, for that is quicker than to pick those listed."""
    f = np.float32
    one, scale, steps, most = f(1), f(SCALE), f(WEIGHT_STEPS), f(MAX_WEIGHT)
    reach, bands = f(2 * truncation), f(1 / truncation)
    spot, ray, found, held = cells.spot, cells.ray, cells.found, cells.held
    for cell in range(CELLS):
        d, n0, n1, n2 = cells.depth[cell], found[1, cell], found[2, cell], found[3, cell]
        px, py = ray[0, cell] * d, ray[1, cell] * d
        s = (n0 * (spot[0, cell] - px) + n1 * (spot[1, cell] - py) + n2 * (spot[2, cell] - d)) * bands
        s = one if d - spot[2, cell] > reach else s
        facing = -(n0 * px + n1 * py + n2 * d) / np.sqrt(px * px + py * py + d * d)
        added = max(one, np.floor(steps * max(facing, f(0)) / max(one, d * d) + f(0.5)))
        added = added if s >= -one else f(0)
        total = held[2, cell] + added
        share = added / max(total, one)
        held[0, cell] += np.rint(share * (min(s, one) * scale - held[0, cell]))
        held[1, cell] += np.rint(share * (found[0, cell] * scale - held[1, cell])) if abs(s) < one else f(0)
        held[2, cell] = min(total, most)


@njit(**OPTIONS)
def integrate(blocks, rows, view, voxel, truncation):
    """Add a view to the blocks ``rows``."""
    spot, ray, depth = np.empty((3, CELLS), np.float32), np.empty((2, CELLS), np.float32), np.empty(CELLS, np.float32)
    pixel, slope, seen = np.empty(CELLS, np.uint32), np.empty(CELLS, np.uint32), np.empty(CELLS + 1, np.uint32)
    found, held = np.zeros((4, CELLS), np.float32), np.zeros((3, CELLS), np.float32)
    cells = Cells(spot, ray, pixel, slope, seen, depth, found, held)
    for row in rows:
        voxels = blocks.voxels[row]
        project(blocks.place[row], voxel, view, cells)
        count = fetch(voxels, view, np.float32(2 * truncation), cells)
        if count > 0:
            average(cells, truncation)
        for n in range(count):
            cell = seen[n]
            voxels[cell, 0] = np.int16(held[0, cell])
            voxels[cell, 1] = np.int16(held[1, cell])
            voxels[cell, 2] = np.int16(held[2, cell])
