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

OPTIONS = {"nogil": True, "cache": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp", "reassoc"}}
INLINE = {**OPTIONS, "inline": "always"}  # calls would count references to every array they pass


class Blocks(NamedTuple):
    """keys: int64 [slots], the hash table, ``EMPTY`` where free; row: int32 [slots]. place: int64 [rows], the key of
    each block. voxels: int16 [rows, 512, 3], x fastest: distance, luminance, weight."""

    keys: NDArray[np.int64]
    row: NDArray[np.int32]
    place: NDArray[np.int64]
    voxels: NDArray[np.int16]


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
