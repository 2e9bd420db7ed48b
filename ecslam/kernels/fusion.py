"""Loops of the fused TSDF volume (numba): blocks of 8 x 8 x 8 voxels, found through an open-addressing hash table.

A voxel is three int16: signed distance in units of the truncation and luminance (both ``SCALE`` to the unit), and a
weight, 0 where nothing has been seen. Lattice point k of the volume lies at ``k * voxel`` metres.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

EDGE = 8
CELLS = EDGE**3
SCALE = 32000.0
EMPTY = np.int64(-1)
BITS = 21
HALF = 1 << (BITS - 1)
MASK = (1 << BITS) - 1
MAX_WEIGHT = 200
WEIGHT_STEPS = 8.0
NORMAL_BASELINE_M = 0.03
NORMAL_STRIDE = 2
NEAREST_M = 0.05

OPTIONS = {"nogil": True, "cache": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp", "reassoc"}}
INLINE = {**OPTIONS, "inline": "always"}  # calls would count references to every array they pass


class Blocks(NamedTuple):
    """keys: int64 [slots], the hash table, ``EMPTY`` where free; row: int32 [slots]. place: int64 [rows], the key of
    each block. voxels: int16 [rows, 512, 3], x fastest: distance, luminance, weight."""

    keys: NDArray[np.int64]
    row: NDArray[np.int32]
    place: NDArray[np.int64]
    voxels: NDArray[np.int16]


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


@njit(**INLINE)
def slot_of(keys, key):
    """Where ``key`` is in the table, or the free slot where it belongs."""
    mask = keys.size - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64(mixed >> np.uint64(32)) & mask
    while keys[slot] != EMPTY and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@njit(**INLINE)
def block_key(x, y, z):
    """The key of the block at integer block coordinates."""
    return ((np.int64(x) + HALF) << (2 * BITS)) | ((np.int64(y) + HALF) << BITS) | (np.int64(z) + HALF)


@njit(**OPTIONS)
def rehash(blocks, used):
    """Enter the first ``used`` blocks into an empty table."""
    for r in range(used):
        slot = slot_of(blocks.keys, blocks.place[r])
        blocks.keys[slot] = blocks.place[r]
        blocks.row[slot] = r


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


@njit(**INLINE)
def project(key, voxel, view, spot, pixel):
    """Where a block's voxels lie in the camera when the row that sees them is read: spot float64 [3, 512] metres; pixel
    int32 [512], row by row, -1 outside the image. Without branches, so that it is done for several at once."""
    fx, fy, cx, cy = view.camera
    m = view.c2w
    height, width = view.depth.shape
    t0, t1, t2, w0, w1, w2 = view.sweep
    moving = (abs(t0) + abs(t1) + abs(t2) + abs(w0) + abs(w1) + abs(w2)) > 0
    bx = ((key >> (2 * BITS)) - HALF) * EDGE
    by = (((key >> BITS) & MASK) - HALF) * EDGE
    bz = ((key & MASK) - HALF) * EDGE
    for line in range(EDGE * EDGE):
        wy, wz = (by + (line & 7)) * voxel - m[1, 3], (bz + (line >> 3)) * voxel - m[2, 3]
        for k in range(EDGE):
            wx = (bx + k) * voxel - m[0, 3]
            x = m[0, 0] * wx + m[1, 0] * wy + m[2, 0] * wz
            y = m[0, 1] * wx + m[1, 1] * wy + m[2, 1] * wz
            z = m[0, 2] * wx + m[1, 2] * wy + m[2, 2] * wz
            if moving:
                share = min(max((fy * y / max(z, NEAREST_M) + cy + 0.5) / height - 0.5, -0.5), 0.5)
                dx, dy, dz = drift(view.sweep, x, y, z)
                x, y, z = x - share * dx, y - share * dy, z - share * dz
            cell = EDGE * line + k
            spot[0, cell], spot[1, cell], spot[2, cell] = x, y, z
            ahead = max(z, NEAREST_M)
            u, v = np.floor(fx * x / ahead + cx + 0.5), np.floor(fy * y / ahead + cy + 0.5)
            inside = (z > NEAREST_M) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
            pixel[cell] = np.int32(v * width + u) if inside else -1


@njit(**OPTIONS)
def integrate(blocks, rows, view, voxel, truncation):
    """Add a view to the blocks ``rows``: running averages of the distance to the tangent plane of the measured surface
    (cut off at the truncation) and of the luminance near it."""
    fx, fy, cx, cy = view.camera
    width = view.depth.shape[1]
    depth, light = view.depth.reshape(-1), view.light.reshape(-1)
    spot, pixel = np.empty((3, CELLS)), np.empty(CELLS, np.int32)
    for row in rows:
        voxels = blocks.voxels[row]
        project(blocks.place[row], voxel, view, spot, pixel)
        for cell in range(CELLS):
            at = pixel[cell]
            if at < 0:
                continue
            x, y, z, d = spot[0, cell], spot[1, cell], spot[2, cell], depth[at]
            if d <= 0 or d < z - 2 * truncation:
                continue
            v = at // width
            u = at - v * width
            i, j = min(v // NORMAL_STRIDE, view.normal.shape[0] - 1), min(u // NORMAL_STRIDE, view.normal.shape[1] - 1)
            n0, n1, n2 = view.normal[i, j, 0], view.normal[i, j, 1], view.normal[i, j, 2]
            px, py = (u - cx) / fx * d, (v - cy) / fy * d
            s = (n0 * (x - px) + n1 * (y - py) + n2 * (z - d)) / truncation
            if d - z > 2 * truncation:
                s = 1.0
            if s < -1:
                continue
            facing = -(n0 * px + n1 * py + n2 * d) / np.sqrt(px * px + py * py + d * d)
            added = max(1.0, np.floor(WEIGHT_STEPS * max(facing, 0.0) / max(1.0, d * d) + 0.5))
            held = float(voxels[cell, 2])
            share = added / (held + added)
            voxels[cell, 0] += np.int16(np.rint(share * (min(s, 1.0) * SCALE - voxels[cell, 0])))
            if abs(s) < 1:
                voxels[cell, 1] += np.int16(np.rint(share * (light[at] * SCALE - voxels[cell, 1])))
            voxels[cell, 2] = np.int16(min(held + added, MAX_WEIGHT))


@njit(**INLINE)
def row_of(blocks, x, y, z):
    """The row of the block at integer block coordinates, -1 where there is none."""
    slot = slot_of(blocks.keys, block_key(x, y, z))
    return -1 if blocks.keys[slot] == EMPTY else np.int64(blocks.row[slot])


@njit(**INLINE)
def corners(blocks, ix, iy, iz, distance, light):
    """The eight voxels from lattice point (ix, iy, iz) on, x fastest; False where any of them is unseen."""
    voxels = blocks.voxels
    x, y, z = ix >> 3, iy >> 3, iz >> 3
    row = row_of(blocks, x, y, z)
    a, b, c = ix & 7, iy & 7, iz & 7
    inside = a < 7 and b < 7 and c < 7
    if inside and row < 0:
        return False
    for corner in range(8):
        kx, ky, kz = a + (corner & 1), b + ((corner >> 1) & 1), c + (corner >> 2)
        at = row
        if not inside and (kx | ky | kz) & 8:
            at = row_of(blocks, x + (kx >> 3), y + (ky >> 3), z + (kz >> 3))
        if at < 0:
            return False
        cell = (kx & 7) | ((ky & 7) << 3) | ((kz & 7) << 6)
        if voxels[at, cell, 2] == 0:
            return False
        distance[corner], light[corner] = voxels[at, cell, 0], voxels[at, cell, 1]
    return True


@njit(**INLINE)
def trilinear(values, tx, ty, tz, out, first):
    """Value and gradient (per lattice step) between eight corner values into ``out`` from ``first`` on."""
    c00, d00 = values[0] + tx * (values[1] - values[0]), values[1] - values[0]
    c10, d10 = values[2] + tx * (values[3] - values[2]), values[3] - values[2]
    c01, d01 = values[4] + tx * (values[5] - values[4]), values[5] - values[4]
    c11, d11 = values[6] + tx * (values[7] - values[6]), values[7] - values[6]
    c0, c1 = c00 + ty * (c10 - c00), c01 + ty * (c11 - c01)
    out[first] = c0 + tz * (c1 - c0)
    d0, d1 = d00 + ty * (d10 - d00), d01 + ty * (d11 - d01)
    out[first + 1] = d0 + tz * (d1 - d0)
    out[first + 2] = (c10 - c00) + tz * ((c11 - c01) - (c10 - c00))
    out[first + 3] = c1 - c0


@njit(**INLINE)
def sample(blocks, x, y, z, voxel, truncation, distance, light, out):
    """Trilinear distance (metres), its gradient, luminance, its gradient into ``out`` [8]; False where any of the eight
    corners is unseen. distance, light: room for eight numbers."""
    gx, gy, gz = x / voxel, y / voxel, z / voxel
    ix, iy, iz = np.int64(np.floor(gx)), np.int64(np.floor(gy)), np.int64(np.floor(gz))
    if not corners(blocks, ix, iy, iz, distance, light):
        return False
    trilinear(distance, gx - ix, gy - iy, gz - iz, out, 0)
    trilinear(light, gx - ix, gy - iy, gz - iz, out, 4)
    out[0] *= truncation / SCALE
    out[4] /= SCALE
    for k in range(1, 4):
        out[k] *= truncation / (SCALE * voxel)
        out[4 + k] /= SCALE * voxel
    return True


@njit(**OPTIONS)
def sample_points(blocks, points, voxel, truncation, distance, known):
    """Distances (metres) of world points and whether each is known."""
    distances, lights, out = np.empty(8), np.empty(8), np.zeros(8)
    for i in range(points.shape[0]):
        known[i] = sample(blocks, points[i, 0], points[i, 1], points[i, 2], voxel, truncation, distances, lights, out)
        distance[i] = out[0]


@njit(**INLINE)
def add_residual(sums, residual, kernel, rx, ry, rz, gx, gy, gz):
    """Add one Geman-McClure weighted residual with position gradient g at lever arm r; returns its weight."""
    share = kernel * kernel / (kernel * kernel + residual * residual)
    weight = share * share
    j = (gx, gy, gz, ry * gz - rz * gy, rz * gx - rx * gz, rx * gy - ry * gx)
    for a in range(6):
        scaled = weight * j[a]
        for b in range(a, 6):
            sums[6 * a + b] += scaled * j[b]
        sums[36 + a] += scaled * residual
    sums[42] += 0.5 * residual * residual * share
    return weight


@njit(**OPTIONS)
def align_sums(blocks, c2w, points, light, voxel, settings, sums):
    """Gauss-Newton sums [45] of camera points: jtj (36, the upper triangle alone), jtr (6), cost, inliers, used."""
    truncation, kernel, limit, low, high, colour, colour_kernel = settings
    distances, lights, out = np.empty(8), np.empty(8), np.empty(8)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        rx = c2w[0, 0] * x + c2w[0, 1] * y + c2w[0, 2] * z
        ry = c2w[1, 0] * x + c2w[1, 1] * y + c2w[1, 2] * z
        rz = c2w[2, 0] * x + c2w[2, 1] * y + c2w[2, 2] * z
        if not sample(
            blocks, rx + c2w[0, 3], ry + c2w[1, 3], rz + c2w[2, 3], voxel, truncation, distances, lights, out
        ):
            continue
        norm = np.sqrt(out[1] * out[1] + out[2] * out[2] + out[3] * out[3])
        if abs(out[0]) >= limit * truncation or norm <= low or norm >= high:
            continue
        sums[44] += 1
        sums[43] += add_residual(sums, out[0], kernel, rx, ry, rz, out[1], out[2], out[3]) > 0.5
        if colour > 0:
            e = (out[4] - light[i]) * colour
            k = colour_kernel * colour
            add_residual(sums, e, k, rx, ry, rz, colour * out[5], colour * out[6], colour * out[7])
