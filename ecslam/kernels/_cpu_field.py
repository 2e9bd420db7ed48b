"""The field at a chunk of points, jitted: what one thread does with data that fit its cache.

Points lie structure-of-arrays, eight to a vector, ``pitch`` apart per component; hidden units lie 64 to a point. The
one-blob encoding has three non-zero bins an axis, so the first layer sees 2 L + 9 inputs instead of 2 L + 3 bins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ._cpu_math import BOTH, HALF, INNER, PART, dots, sigmoid
from ._cpu_simd import (
    exact_fma,
    floor,
    fma,
    highest,
    isplat,
    load,
    load16,
    lowest,
    splat,
    splat16,
    store,
    to_int,
    twice,
    unzip,
)
from ._cpu_table import gather
from ._cpu_tile import COLUMNS, ROWS, make_tile

BLOCK = 32  # points whose hidden units stay in the first-level cache through all passes
P1, P2 = -1640531535, 805459861
OFFSET, MASK, FIRST, DIMS = 0, 1, 2, 5
ANCHOR, BLOB_LOW, BLOB_INV, LOW, HIGH = 0, 3, 6, 9, 12

tile_relu = make_tile(True, True)


class Grid(NamedTuple):
    """A GridLayout as jitted code reads it: levels int32 [L, 8] (offset, mask, first, dims), inverse voxel sizes [L, 2]
    and geometry [15] (anchor, blob low, 1 / blob size, box low, box high) in float64, one-blob bins."""

    levels: np.ndarray
    inverse: np.ndarray
    geometry: np.ndarray
    bins: int


class Net(NamedTuple):
    """The decoders as jitted code reads them, flat. features: [padded, 64]; features_t: [64, padded]; blob:
    [3, bins + 2, 64], wrapped around; blob_steps: its differences between rows; sdf: [32]; rgb: [3, 32]. padded:
    number of hash features, up to whole tiles."""

    features: np.ndarray
    features_t: np.ndarray
    blob: np.ndarray
    blob_steps: np.ndarray
    sdf: np.ndarray
    rgb: np.ndarray
    padded: int


class Scratch(NamedTuple):
    """What a chunk of ``pitch`` points needs, flat. world: positions float64 [3]; x: positions from the anchor on the
    box, rounded, and what rounding lost [6]; inside: 1 or 0 per axis [3];
    enc: features [padded]; jac: their derivatives per metre [3 padded]; bin: first of three bins [3]; coef: bin values
    [9]; slope: d(bin value)/dx at the outer two [6]; hidden: [pitch, 64]; out: TSDF, colour [4]; up: gradients of
    those before the sigmoid [4]; d_enc [padded]; d_x [3]; turn: for transposing; alpha, before, weight, sharp: for
    rendering; rows: of the table at cells' corners [8]; part: fractions of a cell [3]."""

    world: np.ndarray
    x: np.ndarray
    inside: np.ndarray
    enc: np.ndarray
    jac: np.ndarray
    bin: np.ndarray
    coef: np.ndarray
    slope: np.ndarray
    hidden: np.ndarray
    out: np.ndarray
    up: np.ndarray
    d_enc: np.ndarray
    d_x: np.ndarray
    turn: np.ndarray
    alpha: np.ndarray
    before: np.ndarray
    weight: np.ndarray
    sharp: np.ndarray
    rows: np.ndarray
    part: np.ndarray


def scratch_floats(pitch, padded):
    """Sizes of the two flat buffers that ``carve`` cuts up: what a chunk leaves behind, and the rest."""
    each = 4 * padded + 6 + 3 + 3 + 9 + 6 + BOTH + 4 + 4 + 3 + 8 + 3 + 4
    return pitch * (6 + padded), pitch * each + 8 * padded + 192


@njit(**INNER)
def carve(kept, buffer, pitch, padded):
    """A Scratch inside flat buffers: positions and feature gradients (for ``table_back``) in ``kept``."""
    x, d_enc = kept[: 6 * pitch], kept[6 * pitch :]
    world = buffer[: 6 * pitch].view(np.float64)
    at = 6 * pitch
    inside = buffer[at : at + 3 * pitch]
    at += 3 * pitch
    enc = buffer[at : at + padded * pitch]
    at += padded * pitch
    jac = buffer[at : at + 3 * padded * pitch]
    at += 3 * padded * pitch
    bins = buffer[at : at + 3 * pitch].view(np.int32)
    at += 3 * pitch
    coef = buffer[at : at + 9 * pitch]
    at += 9 * pitch
    slope = buffer[at : at + 6 * pitch]
    at += 6 * pitch
    hidden = buffer[at : at + BOTH * pitch]
    at += BOTH * pitch
    out = buffer[at : at + 4 * pitch]
    at += 4 * pitch
    up = buffer[at : at + 4 * pitch]
    at += 4 * pitch
    d_x = buffer[at : at + 3 * pitch]
    at += 3 * pitch
    turn = buffer[at : at + 8 * padded + 192]
    at += 8 * padded + 192
    rows = buffer[at : at + 8 * pitch].view(np.int32)
    at += 8 * pitch
    part = buffer[at : at + 3 * pitch]
    at += 3 * pitch
    rest = buffer[at : at + 4 * pitch]
    alpha, before, weight, sharp = rest[:pitch], rest[pitch : 2 * pitch], rest[2 * pitch : 3 * pitch], rest[3 * pitch :]
    return Scratch(
        world,
        x,
        inside,
        enc,
        jac,
        bins,
        coef,
        slope,
        hidden,
        out,
        up,
        d_enc,
        d_x,
        turn,
        alpha,
        before,
        weight,
        sharp,
        rows,
        part,
    )


@njit(**INNER)
def place(grid, s, n, pitch):
    """Clamp world positions onto the box, note which axes moved, find the one-blob bins and their values."""
    g = grid.geometry
    for axis in range(3):
        anchor, low, high = g[ANCHOR + axis], g[LOW + axis], g[HIGH + axis]
        for i in range(axis * pitch, axis * pitch + n):
            world = s.world[i]
            x = min(max(world, low), high)
            s.inside[i] = x == world
            x -= anchor
            s.x[i] = x
            s.x[3 * pitch + i] = x - np.float64(s.x[i])
    bins, one = grid.bins, splat(np.float32(1))
    third, fifth = splat(np.float32(-2 / 3)), splat(np.float32(0.2))
    for axis in range(3):
        start, inverse = splat(g[BLOB_LOW + axis] - g[ANCHOR + axis]), splat(g[BLOB_INV + axis])
        scale = splat(np.float32(0.9375))
        steep = splat(0.9375 * bins * g[BLOB_INV + axis])
        for p in range(0, n, 8):
            at = axis * pitch + p
            x = load(s.x, at)
            u = (x - start) * inverse
            t = (u - floor(u)) * splat(np.float32(bins))
            c = lowest(floor(t), splat(np.float32(bins - 1)))
            store(s.bin, at, to_int(c))
            left = c - t
            right = left + one
            a, b = left * left, right * right
            rise_a = scale * left * (one + a * (third + fifth * a)) + splat(np.float32(0.5))
            rise_b = scale * right * (one + b * (third + fifth * b)) + splat(np.float32(0.5))
            store(s.coef, 3 * axis * pitch + p, rise_a)
            store(s.coef, (3 * axis + 1) * pitch + p, rise_b - rise_a)
            store(s.coef, (3 * axis + 2) * pitch + p, one - rise_b)
            store(s.slope, 2 * axis * pitch + p, steep * (one - a) * (one - a))
            store(s.slope, (2 * axis + 1) * pitch + p, steep * (one - b) * (one - b))


@njit(**INNER)
def split(x, rest, inverse, lost):
    """Cell coordinate and fraction of a position x + rest with inverse voxel size inverse + lost, as if in float64: the
    derivative of the field jumps where the cell changes."""
    cell = floor(x * inverse)
    fraction = exact_fma(x, inverse, splat(np.float32(0)) - cell) + fma(rest, inverse, x * lost)
    over = floor(fraction)
    return cell + over, fraction - over


@njit(**INNER)
def locate(grid, level, x, at, pitch):
    """Cell of the points x[:, at : at + 8] at one level: integer coordinates and fractions."""
    g, inverse, lost = grid.levels, splat(grid.inverse[level, 0]), splat(grid.inverse[level, 1])
    cx, fx = split(load(x, at), load(x, 3 * pitch + at), inverse, lost)
    cy, fy = split(load(x, pitch + at), load(x, 4 * pitch + at), inverse, lost)
    cz, fz = split(load(x, 2 * pitch + at), load(x, 5 * pitch + at), inverse, lost)
    if g[level, DIMS] > 0:  # rounding must not leave the stored block
        cx, fx = inside_block(cx, fx, g[level, FIRST], g[level, DIMS])
        cy, fy = inside_block(cy, fy, g[level, FIRST + 1], g[level, DIMS + 1])
        cz, fz = inside_block(cz, fz, g[level, FIRST + 2], g[level, DIMS + 2])
    return to_int(cx), to_int(cy), to_int(cz), fx, fy, fz


@njit(**INNER)
def inside_block(cell, fraction, first, count):
    """Clamp cell coordinates to the cells between ``count`` lattice points."""
    clamped = lowest(highest(cell, splat(np.float32(first))), splat(np.float32(first + count - 2)))
    return clamped, fraction + (cell - clamped)


@njit(**INNER)
def corners(levels, level, x, y, z, rows, at):
    """Table rows [8, 8] of the eight corners (x fastest) of eight cells with integer coordinates x, y, z."""
    one, offset = isplat(1), isplat(levels[level, OFFSET])
    nx, ny = levels[level, DIMS], levels[level, DIMS + 1]
    if nx > 0:
        row, slab = isplat(nx), isplat(nx * ny)
        first = levels[level, FIRST] + nx * (levels[level, FIRST + 1] + ny * levels[level, FIRST + 2])
        a = x + y * row + z * slab + (offset - isplat(first))
        b, c = a + row, a + slab
        d = c + row
        store(rows, at, a)
        store(rows, at + 8, a + one)
        store(rows, at + 16, b)
        store(rows, at + 24, b + one)
        store(rows, at + 32, c)
        store(rows, at + 40, c + one)
        store(rows, at + 48, d)
        store(rows, at + 56, d + one)
    else:
        mask, x1 = isplat(levels[level, MASK]), x + one
        y0, z0 = y * isplat(P1), z * isplat(P2)
        y1, z1 = y0 + isplat(P1), z0 + isplat(P2)
        a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        store(rows, at, ((a ^ x) & mask) + offset)
        store(rows, at + 8, ((a ^ x1) & mask) + offset)
        store(rows, at + 16, ((b ^ x) & mask) + offset)
        store(rows, at + 24, ((b ^ x1) & mask) + offset)
        store(rows, at + 32, ((c ^ x) & mask) + offset)
        store(rows, at + 40, ((c ^ x1) & mask) + offset)
        store(rows, at + 48, ((d ^ x) & mask) + offset)
        store(rows, at + 56, ((d ^ x1) & mask) + offset)


@njit(**INNER)
def interpolate(table, rows, at, fx, fy, fz):
    """Both features at eight points, trilinear, from their cells' ``rows`` [64], and their derivatives per cell."""
    fx, fy, fz = twice(fx), twice(fy), twice(fz)
    v0, v1 = gather(table, rows, at), gather(table, rows, at + 8)
    v2, v3 = gather(table, rows, at + 16), gather(table, rows, at + 24)
    v4, v5 = gather(table, rows, at + 32), gather(table, rows, at + 40)
    v6, v7 = gather(table, rows, at + 48), gather(table, rows, at + 56)
    a, b, c, d = v1 - v0, v3 - v2, v5 - v4, v7 - v6
    p, q, r, s = v0 + fx * a, v2 + fx * b, v4 + fx * c, v6 + fx * d
    low, high = q - p, s - r
    bottom, top = p + fy * low, r + fy * high
    near, far = a + fy * (b - a), c + fy * (d - c)
    rise = top - bottom
    return unzip(bottom + fz * rise), unzip(near + fz * (far - near)), unzip(low + fz * (high - low)), unzip(rise)


@njit(**INNER)
def encode(grid, table, s, n, pitch, padded, want_jac):
    """Hash features of the points in ``s.x`` (paper, equation 1) and, if wanted, their derivatives.

    A level's rows are found for all points first, so that many reads of the table are under way at once.
    """
    for level in range(grid.levels.shape[0]):
        inverse = splat(grid.inverse[level, 0])
        for p in range(0, n, 8):
            x, y, z, fx, fy, fz = locate(grid, level, s.x, p, pitch)
            corners(grid.levels, level, x, y, z, s.rows, 8 * p)
            store(s.part, p, fx)
            store(s.part, pitch + p, fy)
            store(s.part, 2 * pitch + p, fz)
        for p in range(0, n, 8):
            fx, fy, fz = load(s.part, p), load(s.part, pitch + p), load(s.part, 2 * pitch + p)
            (v0, v1), (x0, x1), (y0, y1), (z0, z1) = interpolate(table, s.rows, 8 * p, fx, fy, fz)
            at = 2 * level * pitch + p
            store(s.enc, at, v0)
            store(s.enc, at + pitch, v1)
            if want_jac:
                store(s.jac, at, x0 * inverse)
                store(s.jac, at + pitch, x1 * inverse)
                store(s.jac, padded * pitch + at, y0 * inverse)
                store(s.jac, (padded + 1) * pitch + at, y1 * inverse)
                store(s.jac, 2 * padded * pitch + at, z0 * inverse)
                store(s.jac, (2 * padded + 1) * pitch + at, z1 * inverse)


@njit(**INNER)
def blob_layer(blob, bins, s, first, last, pitch):
    """First-layer sums of the one-blob inputs of points first..last: starts ``s.hidden``."""
    for p in range(first, last):
        i = BOTH * s.bin[p]
        j = BOTH * (s.bin[pitch + p] + bins + 2)
        k = BOTH * (s.bin[2 * pitch + p] + 2 * (bins + 2))
        a, b, c = splat16(s.coef[p]), splat16(s.coef[pitch + p]), splat16(s.coef[2 * pitch + p])
        d, e, f = splat16(s.coef[3 * pitch + p]), splat16(s.coef[4 * pitch + p]), splat16(s.coef[5 * pitch + p])
        g, h, m = splat16(s.coef[6 * pitch + p]), splat16(s.coef[7 * pitch + p]), splat16(s.coef[8 * pitch + p])
        for v in range(0, BOTH, 16):
            x = a * load16(blob, i + v) + b * load16(blob, i + v + BOTH) + c * load16(blob, i + v + 2 * BOTH)
            y = d * load16(blob, j + v) + e * load16(blob, j + v + BOTH) + f * load16(blob, j + v + 2 * BOTH)
            z = g * load16(blob, k + v) + h * load16(blob, k + v + BOTH) + m * load16(blob, k + v + 2 * BOTH)
            store(s.hidden, BOTH * p + v, x + y + z)


@njit(**INNER)
def decode(net, s, first, last, pitch):
    """TSDF and colour of points first..last from ``s.hidden``."""
    for p in range(first, last, 8):
        store(s.out, p, dots(s.hidden, BOTH * p, net.sdf, 0))
        for channel in range(3):
            raw = dots(s.hidden, BOTH * p + HALF, net.rgb, HALF * channel)
            store(s.out, (channel + 1) * pitch + p, sigmoid(raw))


@njit(**PART)
def forward(grid, table, net, s, n, pitch, want_jac):
    """From world positions in ``s.world`` to TSDF and colour in ``s.out``; n is a multiple of 8."""
    place(grid, s, n, pitch)
    s.enc[2 * grid.levels.shape[0] * pitch :] = 0
    encode(grid, table, s, n, pitch, net.padded, want_jac)
    for first in range(0, n, BLOCK):
        last = min(first + BLOCK, n)
        blob_layer(net.blob, grid.bins, s, first, last, pitch)
        for p in range(first, last, ROWS):
            for v in range(0, BOTH, COLUMNS):
                tile_relu(s.hidden, BOTH * p + v, BOTH, s.enc, p, 1, pitch, net.features, v, BOTH, net.padded)
        decode(net, s, first, last, pitch)
