"""The way back through the field at a chunk of points, jitted: gradients of the table, the decoders and the points."""

from __future__ import annotations

import numpy as np
from numba import njit

from ._cpu_field import MASK, OFFSET, corners, locate
from ._cpu_math import BOTH, HALF, INNER, eight_sums
from ._cpu_simd import (
    fetch_add,
    fold,
    isplat,
    lanes,
    load,
    load16,
    same_bits,
    slide,
    splat,
    splat16,
    store,
    transpose,
    where_positive,
    zero_bits,
)
from ._cpu_table import scatter_add
from ._cpu_tile import COLUMNS, ROWS, make_tile

TABLE_SCRATCH = 2 * 64 + 40

tile_set = make_tile(False, False)
tile_add = make_tile(True, False)


@njit(**INNER)
def hidden_back(net, s, first, last, pitch, d_sdf, d_rgb):
    """Turn hidden activations of points first..last into their gradients in place, from ``s.up``; adds the second
    layer's gradients."""
    for v in range(0, HALF, 16):
        w, total = load16(net.sdf, v), load16(d_sdf, v)
        for p in range(first, last):
            h, g = load16(s.hidden, BOTH * p + v), splat16(s.up[p])
            total = total + g * h
            store(s.hidden, BOTH * p + v, where_positive(h, g * w))
        store(d_sdf, v, total)
    for v in range(0, HALF, 16):
        wr, wg, wb = load16(net.rgb, v), load16(net.rgb, HALF + v), load16(net.rgb, 2 * HALF + v)
        tr, tg, tb = load16(d_rgb, v), load16(d_rgb, HALF + v), load16(d_rgb, 2 * HALF + v)
        for p in range(first, last):
            h = load16(s.hidden, BOTH * p + HALF + v)
            r, g, b = splat16(s.up[pitch + p]), splat16(s.up[2 * pitch + p]), splat16(s.up[3 * pitch + p])
            tr, tg, tb = tr + r * h, tg + g * h, tb + b * h
            store(s.hidden, BOTH * p + HALF + v, where_positive(h, r * wr + g * wg + b * wb))
        store(d_rgb, v, tr)
        store(d_rgb, HALF + v, tg)
        store(d_rgb, 2 * HALF + v, tb)


@njit(**INNER)
def features_back(net, s, first, last, pitch, begin, end):
    """Gradients of the hash features of points first..last from hidden units begin..end, into ``s.d_enc``."""
    padded = net.padded
    for p in range(first, last, 8):
        for i in range(0, 8, ROWS):
            for v in range(0, padded, COLUMNS):
                tile_set(
                    s.turn, i * padded + v, padded, s.hidden, BOTH * (p + i) + begin, BOTH, 1,
                    net.features_t, begin * padded + v, padded, end - begin,
                )  # fmt: skip
        for v in range(0, padded, 8):
            transpose(s.turn, v, padded, s.d_enc, v * pitch + p, pitch)


@njit(**INNER)
def blob_back(blob, bins, s, p, pitch, begin, end):
    """Derivatives of one point's TSDF and colour along the three axes through the one-blob inputs: their lane-wise
    partial sums go to ``s.turn`` [3, 8, 8]."""
    i = BOTH * s.bin[p]
    j = BOTH * (s.bin[pitch + p] + bins + 2)
    k = BOTH * (s.bin[2 * pitch + p] + 2 * (bins + 2))
    a, b, c = splat16(s.slope[p]), splat16(s.slope[2 * pitch + p]), splat16(s.slope[4 * pitch + p])
    d, e, f = splat16(s.slope[pitch + p]), splat16(s.slope[3 * pitch + p]), splat16(s.slope[5 * pitch + p])
    x = y = z = splat16(np.float32(0))
    for v in range(begin, end, 16):
        g = load16(s.hidden, BOTH * p + v)
        x = x + g * (a * load16(blob, i + v) + d * load16(blob, i + v + BOTH))
        y = y + g * (b * load16(blob, j + v) + e * load16(blob, j + v + BOTH))
        z = z + g * (c * load16(blob, k + v) + f * load16(blob, k + v + BOTH))
    at = 8 * (p & 7)
    store(s.turn, at, fold(x))
    store(s.turn, at + 64, fold(y))
    store(s.turn, at + 128, fold(z))


@njit(**INNER)
def points_back(grid, net, s, first, last, pitch, begin, end):
    """Position gradients of points first..last, into ``s.d_x``, from ``s.d_enc`` and hidden units begin..end."""
    features, jac = 2 * grid.levels.shape[0], net.padded * pitch
    for p in range(first, last, 8):
        x = y = z = splat(np.float32(0))
        for i in range(p, p + features * pitch, pitch):
            g = load(s.d_enc, i)
            x = x + g * load(s.jac, i)
            y = y + g * load(s.jac, i + jac)
            z = z + g * load(s.jac, i + 2 * jac)
        for q in range(p, p + 8):
            blob_back(net.blob_steps, grid.bins, s, q, pitch, begin, end)
        x, y, z = x + eight_sums(s.turn, 0), y + eight_sums(s.turn, 64), z + eight_sums(s.turn, 128)
        store(s.d_x, p, x * load(s.inside, p))
        store(s.d_x, pitch + p, y * load(s.inside, pitch + p))
        store(s.d_x, 2 * pitch + p, z * load(s.inside, 2 * pitch + p))


@njit(**INNER)
def weights_back(grid, net, s, first, last, pitch, d_features, d_blob):
    """Add the first layer's gradients from points first..last: d_features [padded, 64], d_blob [3, bins + 2, 64]."""
    for v in range(0, BOTH, COLUMNS):
        for i in range(0, net.padded, ROWS):
            tile_add(
                d_features, BOTH * i + v, BOTH, s.enc, i * pitch + first, pitch, 1,
                s.hidden, BOTH * first + v, BOTH, last - first,
            )  # fmt: skip
    for axis in range(3):
        for v in range(0, BOTH, 32):
            blob_weights_back(s, first, last, pitch, axis, v, d_blob[axis * (grid.bins + 2) * BOTH :])


@njit(**INNER)
def blob_weights_back(s, first, last, pitch, axis, v, d_blob):
    """Thirty-two columns of ``weights_back`` for one axis: neighbours share their bins, so sums stay in registers."""
    zero = splat16(np.float32(0))
    left, right = (zero, zero, zero), (zero, zero, zero)
    last_bin = s.bin[axis * pitch + first]
    for p in range(first, last):
        own = s.bin[axis * pitch + p]
        if own != last_bin:
            add_sums(d_blob, BOTH * last_bin + v, left)
            add_sums(d_blob, BOTH * last_bin + v + 16, right)
            left, right = (zero, zero, zero), (zero, zero, zero)
            last_bin = own
        at = 3 * axis * pitch + p
        a, b, c = splat16(s.coef[at]), splat16(s.coef[at + pitch]), splat16(s.coef[at + 2 * pitch])
        g, h = load16(s.hidden, BOTH * p + v), load16(s.hidden, BOTH * p + v + 16)
        left = left[0] + a * g, left[1] + b * g, left[2] + c * g
        right = right[0] + a * h, right[1] + b * h, right[2] + c * h
    add_sums(d_blob, BOTH * last_bin + v, left)
    add_sums(d_blob, BOTH * last_bin + v + 16, right)


@njit(**INNER)
def add_sums(target, at, sums):
    """Add sixteen columns of three rows, BOTH apart."""
    for row in range(3):
        place = at + row * BOTH
        store(target, place, load16(target, place) + sums[row])


@njit(**INNER)
def next_level(counter, grid, d_table):
    """Take the next level, the finest first, and clear its rows of the table's gradient; below 0 when none is left."""
    level = grid.levels.shape[0] - 1 - fetch_add(counter, 0)
    if level >= 0:
        start = 2 * grid.levels[level, OFFSET]
        d_table[start : start + 2 * grid.levels[level, MASK] + 2] = 0
    return level


@njit(**INNER)
def table_back(grid, level, x, d_enc, at_a, n, pitch, scratch, d_table):
    """Add one level's rows of the table gradient from a chunk of points: x [6, pitch], d_enc [features, pitch], the
    level's two from ``at_a`` on.

    Neighbours on a ray often share a cell: their sums stay in registers, one lane per corner, until the cell changes.
    scratch: float32 [TABLE_SCRATCH], the corners of two times eight cells and what is known of the later eight points.
    """
    rows, parts = scratch[:128].view(np.int32), scratch[128:]
    zero = splat(np.float32(0))
    ux, uy, uz = lanes(-1, 1, -1, 1, -1, 1, -1, 1), lanes(-1, -1, 1, 1, -1, -1, 1, 1), lanes(-1, -1, -1, -1, 1, 1, 1, 1)
    bx, by, bz = lanes(1, 0, 1, 0, 1, 0, 1, 0), lanes(1, 1, 0, 0, 1, 1, 0, 0), lanes(1, 1, 1, 1, 0, 0, 0, 0)
    last_x, last_y, last_z = isplat(-(2**31)), isplat(-(2**31)), isplat(-(2**31))
    sum_a, sum_b = zero, zero
    run, live = 0, False
    for p in range(0, n, 8):
        ix, iy, iz, fx, fy, fz = locate(grid, level, x, p, pitch)
        own = 8 * (p & 8)
        corners(grid.levels, level, ix, iy, iz, rows, own)
        store(parts, 0, fx)
        store(parts, 8, fy)
        store(parts, 16, fz)
        a, b = load(d_enc, at_a + p), load(d_enc, at_a + pitch + p)
        store(parts, 24, a)
        store(parts, 32, b)
        none = zero_bits(a) & zero_bits(b)
        same = same_bits(slide(last_x, ix), ix) & same_bits(slide(last_y, iy), iy) & same_bits(slide(last_z, iz), iz)
        last_x, last_y, last_z = ix, iy, iz
        for i in range(8):
            if live and not (same >> i) & 1:
                scatter_add(d_table, rows, run, sum_a, sum_b)
                live = False
            run = own + i
            if (none >> i) & 1:
                continue
            if not live:
                live, sum_a, sum_b = True, zero, zero
            w = (bx + ux * splat(parts[i])) * (by + uy * splat(parts[8 + i])) * (bz + uz * splat(parts[16 + i]))
            sum_a, sum_b = sum_a + w * splat(parts[24 + i]), sum_b + w * splat(parts[32 + i])
    if live:
        scatter_add(d_table, rows, run, sum_a, sum_b)
