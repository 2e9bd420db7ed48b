"""The field at a chunk of points and its way back, jitted: what one thread does with data that fit its cache.

Points lie structure-of-arrays, eight to a vector, ``pitch`` apart per component; hidden units lie 64 to a point. The
one-blob encoding has three non-zero bins an axis, so the first layer sees 2 L + 9 inputs instead of 2 L + 3 bins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ._cpu_simd import (
    floor,
    fma,
    gather,
    highest,
    isplat,
    load,
    lowest,
    make_tile,
    power_of_two,
    row_sums,
    scatter_add,
    splat,
    store,
    to_int,
    transpose,
    where_equal,
    where_positive,
)

OUTER = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp", "reassoc"}, "cache": True}
INNER = {**OUTER, "cache": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
BOTH = 64
HALF = 32
P1, P2 = -1640531535, 805459861
OFFSET, MASK, FIRST, DIMS = 0, 1, 2, 5
ANCHOR, BLOB_LOW, BLOB_INV, LOW, HIGH = 0, 3, 6, 9, 12

tile_relu = make_tile(4, 2, True, True)
tile_set = make_tile(4, 2, False, False)
tile_add = make_tile(4, 2, True, False)


class Grid(NamedTuple):
    """A GridLayout as jitted code reads it: levels int32 [L, 8] (offset, mask, first, dims), inverse voxel sizes [L],
    geometry float32 [15] (anchor, blob low, 1 / blob size, box low, box high), one-blob bins."""

    levels: np.ndarray
    inverse: np.ndarray
    geometry: np.ndarray
    bins: int


class Net(NamedTuple):
    """The decoders as jitted code reads them, flat. features: [padded, 64]; features_t: [64, padded]; blob:
    [3, bins + 2, 64], wrapped around; sdf: [32]; rgb: [3, 32]. padded: number of hash features, padded to 16."""

    features: np.ndarray
    features_t: np.ndarray
    blob: np.ndarray
    sdf: np.ndarray
    rgb: np.ndarray
    padded: int


class Scratch(NamedTuple):
    """What a chunk of ``pitch`` points needs, flat. x: position from the anchor [3]; inside: 1 or 0 per axis [3];
    enc: features [padded]; jac: their derivatives per metre [3 padded]; bin: first of three bins [3]; coef: bin values
    [9]; slope: d(bin value)/dx at the outer two [6]; hidden: [pitch, 64]; out: TSDF, colour [4]; up: gradients of
    those before the sigmoid [4]; d_enc [padded]; d_x [3]; turn [8, padded]; alpha, before, weight, sharp: rendering."""

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


def scratch_floats(pitch, padded):
    """Sizes of the two flat buffers that ``carve`` cuts up: what a chunk leaves behind, and the rest."""
    return pitch * (3 + padded), pitch * (4 * padded + 3 + 3 + 9 + 6 + BOTH + 4 + 4 + 3 + 4) + 8 * padded


@njit(**INNER)
def carve(kept, buffer, pitch, padded):
    """A Scratch inside flat buffers: positions and feature gradients (for ``table_back``) in ``kept``."""
    x, d_enc = kept[: 3 * pitch], kept[3 * pitch :]
    at = 0
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
    turn = buffer[at : at + 8 * padded]
    at += 8 * padded
    rest = buffer[at : at + 4 * pitch]
    alpha, before, weight, sharp = rest[:pitch], rest[pitch : 2 * pitch], rest[2 * pitch : 3 * pitch], rest[3 * pitch :]
    return Scratch(
        x, inside, enc, jac, bins, coef, slope, hidden, out, up, d_enc, d_x, turn, alpha, before, weight, sharp
    )


@njit(**INNER)
def place(grid, s, n, pitch):
    """Clamp world positions in ``s.x`` onto the box, note which axes moved, find the one-blob bins and their values."""
    bins, one = grid.bins, splat(np.float32(1))
    third, fifth = splat(np.float32(-2 / 3)), splat(np.float32(0.2))
    for axis in range(3):
        g = grid.geometry
        low, high, anchor = splat(g[LOW + axis]), splat(g[HIGH + axis]), splat(g[ANCHOR + axis])
        start, inverse = splat(g[BLOB_LOW + axis]), splat(g[BLOB_INV + axis])
        scale = splat(np.float32(0.9375))
        steep = splat(np.float32(0.9375) * bins * g[BLOB_INV + axis])
        for p in range(0, n, 8):
            at = axis * pitch + p
            world = load(s.x, at)
            x = lowest(highest(world, low), high)
            store(s.inside, at, where_equal(x, world, one))
            store(s.x, at, x - anchor)
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
def corners(levels, level, x, y, z):
    """Table rows of the eight corners (x fastest) of the cell with integer coordinates x, y, z."""
    one, offset = isplat(1), isplat(levels[level, OFFSET])
    nx, ny, nz = levels[level, DIMS], levels[level, DIMS + 1], levels[level, DIMS + 2]
    if nx > 0:
        zero = isplat(0)
        x = x - isplat(levels[level, FIRST])
        y = y - isplat(levels[level, FIRST + 1])
        z = z - isplat(levels[level, FIRST + 2])
        ex, ey, ez = isplat(nx - 1), isplat(ny - 1), isplat(nz - 1)
        row, slab = isplat(nx), isplat(nx * ny)
        x0, x1 = lowest(highest(x, zero), ex), lowest(highest(x + one, zero), ex)
        y0, y1 = lowest(highest(y, zero), ey) * row, lowest(highest(y + one, zero), ey) * row
        z0, z1 = lowest(highest(z, zero), ez) * slab + offset, lowest(highest(z + one, zero), ez) * slab + offset
        a, b, c, d = y0 + z0, y1 + z0, y0 + z1, y1 + z1
        return a + x0, a + x1, b + x0, b + x1, c + x0, c + x1, d + x0, d + x1
    mask = isplat(levels[level, MASK])
    y0, z0 = y * isplat(P1), z * isplat(P2)
    y1, z1 = y0 + isplat(P1), z0 + isplat(P2)
    a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    x1 = x + one
    return (
        ((a ^ x) & mask) + offset,
        ((a ^ x1) & mask) + offset,
        ((b ^ x) & mask) + offset,
        ((b ^ x1) & mask) + offset,
        ((c ^ x) & mask) + offset,
        ((c ^ x1) & mask) + offset,
        ((d ^ x) & mask) + offset,
        ((d ^ x1) & mask) + offset,
    )


@njit(**INNER)
def mix(v, fx, fy, fz):
    """Trilinear value of eight corner values and its derivatives per cell."""
    a, b, c, d = v[1] - v[0], v[3] - v[2], v[5] - v[4], v[7] - v[6]
    p, q, r, s = v[0] + fx * a, v[2] + fx * b, v[4] + fx * c, v[6] + fx * d
    low, high = q - p, s - r
    bottom, top = p + fy * low, r + fy * high
    near, far = a + fy * (b - a), c + fy * (d - c)
    rise = top - bottom
    return bottom + fz * rise, near + fz * (far - near), low + fz * (high - low), rise


@njit(**INNER)
def encode(grid, table, s, n, pitch, padded, want_jac):
    """Hash features of the points in ``s.x`` (paper, equation 1) and, if wanted, their derivatives."""
    for level in range(grid.levels.shape[0]):
        inverse = splat(grid.inverse[level])
        for p in range(0, n, 8):
            x, y, z = load(s.x, p) * inverse, load(s.x, pitch + p) * inverse, load(s.x, 2 * pitch + p) * inverse
            cx, cy, cz = floor(x), floor(y), floor(z)
            fx, fy, fz = x - cx, y - cy, z - cz
            k = corners(grid.levels, level, to_int(cx), to_int(cy), to_int(cz))
            a, b, c, d = gather(table, k[0]), gather(table, k[1]), gather(table, k[2]), gather(table, k[3])
            e, f, g, h = gather(table, k[4]), gather(table, k[5]), gather(table, k[6]), gather(table, k[7])
            v0, x0, y0, z0 = mix((a[0], b[0], c[0], d[0], e[0], f[0], g[0], h[0]), fx, fy, fz)
            v1, x1, y1, z1 = mix((a[1], b[1], c[1], d[1], e[1], f[1], g[1], h[1]), fx, fy, fz)
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
def blob_layer(blob, bins, s, n, pitch):
    """First-layer sums of the one-blob inputs: starts ``s.hidden``."""
    for p in range(n):
        i = BOTH * s.bin[p]
        j = BOTH * (s.bin[pitch + p] + bins + 2)
        k = BOTH * (s.bin[2 * pitch + p] + 2 * (bins + 2))
        a, b, c = splat(s.coef[p]), splat(s.coef[pitch + p]), splat(s.coef[2 * pitch + p])
        d, e, f = splat(s.coef[3 * pitch + p]), splat(s.coef[4 * pitch + p]), splat(s.coef[5 * pitch + p])
        g, h, m = splat(s.coef[6 * pitch + p]), splat(s.coef[7 * pitch + p]), splat(s.coef[8 * pitch + p])
        for v in range(0, BOTH, 8):
            x = a * load(blob, i + v) + b * load(blob, i + v + BOTH) + c * load(blob, i + v + 2 * BOTH)
            y = d * load(blob, j + v) + e * load(blob, j + v + BOTH) + f * load(blob, j + v + 2 * BOTH)
            z = g * load(blob, k + v) + h * load(blob, k + v + BOTH) + m * load(blob, k + v + 2 * BOTH)
            store(s.hidden, BOTH * p + v, x + y + z)


@njit(**INNER)
def dot(a, i, b, j):
    """Lane-wise partial sums of the dot product of two rows of 32."""
    return (load(a, i) * load(b, j) + load(a, i + 8) * load(b, j + 8)) + (
        load(a, i + 16) * load(b, j + 16) + load(a, i + 24) * load(b, j + 24)
    )


@njit(**INNER)
def dots(a, i, b, j):
    """Dot products of eight rows of 32, BOTH apart, with one row."""
    return row_sums(
        dot(a, i, b, j),
        dot(a, i + BOTH, b, j),
        dot(a, i + 2 * BOTH, b, j),
        dot(a, i + 3 * BOTH, b, j),
        dot(a, i + 4 * BOTH, b, j),
        dot(a, i + 5 * BOTH, b, j),
        dot(a, i + 6 * BOTH, b, j),
        dot(a, i + 7 * BOTH, b, j),
    )


@njit(**INNER)
def exp_parts(x):
    """(2^k, e^r - 1) with e^x = 2^k e^r and |r| <= ln 2 / 2."""
    x = lowest(highest(x, splat(np.float32(-87))), splat(np.float32(88)))
    k = floor(x * splat(np.float32(1.4426950408889634)) + splat(np.float32(0.5)))
    r = fma(k, splat(np.float32(-0.693145751953125)), x)
    r = fma(k, splat(np.float32(-1.428606765330187e-06)), r)
    q = fma(r, splat(np.float32(1 / 5040)), splat(np.float32(1 / 720)))
    q = fma(r, q, splat(np.float32(1 / 120)))
    q = fma(r, q, splat(np.float32(1 / 24)))
    q = fma(r, q, splat(np.float32(1 / 6)))
    q = fma(r, q, splat(np.float32(0.5)))
    return power_of_two(k), fma(r * r, q, r)


@njit(**INNER)
def exp(x):
    """e^x to about 1e-7."""
    power, rest = exp_parts(x)
    return fma(power, rest, power)


@njit(**INNER)
def expm1(x):
    """e^x - 1, exact to rounding near 0 too."""
    power, rest = exp_parts(x)
    return fma(power, rest, power - splat(np.float32(1)))


@njit(**INNER)
def sigmoid(x):
    """1 / (1 + e^-x)."""
    one = splat(np.float32(1))
    return one / (one + exp(splat(np.float32(0)) - x))


@njit(**INNER)
def decode(net, s, n, pitch):
    """TSDF and colour of the points from ``s.hidden``."""
    for p in range(0, n, 8):
        store(s.out, p, dots(s.hidden, BOTH * p, net.sdf, 0))
        for channel in range(3):
            raw = dots(s.hidden, BOTH * p + HALF, net.rgb, HALF * channel)
            store(s.out, (channel + 1) * pitch + p, sigmoid(raw))


@njit(**INNER)
def forward(grid, table, net, s, n, pitch, want_jac):
    """From world positions in ``s.x`` to TSDF and colour in ``s.out``; n is a multiple of 8."""
    place(grid, s, n, pitch)
    s.enc[2 * grid.levels.shape[0] * pitch :] = 0
    encode(grid, table, s, n, pitch, net.padded, want_jac)
    blob_layer(net.blob, grid.bins, s, n, pitch)
    for p in range(0, n, 4):
        for v in range(0, BOTH, 16):
            tile_relu(s.hidden, BOTH * p + v, BOTH, s.enc, p, 1, pitch, net.features, v, BOTH, net.padded)
    decode(net, s, n, pitch)


@njit(**INNER)
def hidden_back(net, s, n, pitch, d_sdf, d_rgb):
    """Turn hidden activations into their gradients in place, from ``s.up``; adds the second layer's gradients."""
    for v in range(0, HALF, 8):
        w, total = load(net.sdf, v), load(d_sdf, v)
        for p in range(n):
            h, g = load(s.hidden, BOTH * p + v), splat(s.up[p])
            total = total + g * h
            store(s.hidden, BOTH * p + v, where_positive(h, g * w))
        store(d_sdf, v, total)
    for v in range(0, HALF, 8):
        wr, wg, wb = load(net.rgb, v), load(net.rgb, HALF + v), load(net.rgb, 2 * HALF + v)
        tr, tg, tb = load(d_rgb, v), load(d_rgb, HALF + v), load(d_rgb, 2 * HALF + v)
        for p in range(n):
            h = load(s.hidden, BOTH * p + HALF + v)
            r, g, b = splat(s.up[pitch + p]), splat(s.up[2 * pitch + p]), splat(s.up[3 * pitch + p])
            tr, tg, tb = tr + r * h, tg + g * h, tb + b * h
            store(s.hidden, BOTH * p + HALF + v, where_positive(h, r * wr + g * wg + b * wb))
        store(d_rgb, v, tr)
        store(d_rgb, HALF + v, tg)
        store(d_rgb, 2 * HALF + v, tb)


@njit(**INNER)
def features_back(net, s, n, pitch, first, last):
    """Gradients of the hash features from hidden units first..last of ``s.hidden``, into ``s.d_enc``."""
    padded = net.padded
    for p in range(0, n, 8):
        for i in range(0, 8, 4):
            for v in range(0, padded, 16):
                tile_set(
                    s.turn, i * padded + v, padded, s.hidden, BOTH * (p + i) + first, BOTH, 1,
                    net.features_t, first * padded + v, padded, last - first,
                )  # fmt: skip
        for v in range(0, padded, 8):
            transpose(s.turn, v, padded, s.d_enc, v * pitch + p, pitch)


@njit(**INNER)
def blob_slope(blob, at, g0, g1, hidden, h, first, last):
    """Lane-wise partial sums of the derivative along one axis through the one-blob inputs."""
    left, right = splat(g0), splat(g1)
    total = splat(np.float32(0))
    for v in range(first, last, 8):
        a, b, c = load(blob, at + v), load(blob, at + v + BOTH), load(blob, at + v + 2 * BOTH)
        total = total + load(hidden, h + v) * (left * (b - a) + right * (c - b))
    return total


@njit(**INNER)
def points_back(grid, net, s, n, pitch, first, last):
    """Gradients of the positions, into ``s.d_x``, from ``s.d_enc`` and hidden units first..last of ``s.hidden``."""
    blob, bins = net.blob, grid.bins
    for axis in range(3):
        jac = axis * net.padded * pitch
        base = axis * (bins + 2)
        for p in range(0, n, 8):
            total = splat(np.float32(0))
            for i in range(2 * grid.levels.shape[0]):
                total = total + load(s.d_enc, i * pitch + p) * load(s.jac, jac + i * pitch + p)
            for i in range(8):
                q = p + i
                at = BOTH * (s.bin[axis * pitch + q] + base)
                g0, g1 = s.slope[2 * axis * pitch + q], s.slope[(2 * axis + 1) * pitch + q]
                store(s.turn, 8 * i, blob_slope(blob, at, g0, g1, s.hidden, BOTH * q, first, last))
            t = s.turn
            total = total + row_sums(
                load(t, 0), load(t, 8), load(t, 16), load(t, 24), load(t, 32), load(t, 40), load(t, 48), load(t, 56)
            )
            store(s.d_x, axis * pitch + p, total * load(s.inside, axis * pitch + p))


@njit(**INNER)
def weights_back(grid, net, s, n, pitch, d_features, d_blob):
    """Add the first layer's gradients: d_features [padded, 64], d_blob [3, bins + 2, 64]."""
    for v in range(0, BOTH, 16):
        for i in range(0, net.padded, 4):
            tile_add(d_features, BOTH * i + v, BOTH, s.enc, i * pitch, pitch, 1, s.hidden, v, BOTH, n)
    for axis in range(3):
        base = axis * (grid.bins + 2)
        for p in range(n):
            at = BOTH * (s.bin[axis * pitch + p] + base)
            a = splat(s.coef[3 * axis * pitch + p])
            b = splat(s.coef[(3 * axis + 1) * pitch + p])
            c = splat(s.coef[(3 * axis + 2) * pitch + p])
            for v in range(0, BOTH, 8):
                g = load(s.hidden, BOTH * p + v)
                store(d_blob, at + v, load(d_blob, at + v) + a * g)
                store(d_blob, at + v + BOTH, load(d_blob, at + v + BOTH) + b * g)
                store(d_blob, at + v + 2 * BOTH, load(d_blob, at + v + 2 * BOTH) + c * g)


@njit(**INNER)
def corner_pair(d_table, left, right, gx, fx, weight, a, b):
    """Scatter the gradients a, b to two corners that are neighbours along x."""
    low, high = weight * gx, weight * fx
    scatter_add(d_table, left, low * a, low * b)
    scatter_add(d_table, right, high * a, high * b)


@njit(**INNER)
def table_back(grid, level, x, d_enc, n, pitch, d_table):
    """Add one level's rows of the table gradient from a chunk of points: x [3, pitch], d_enc [padded, pitch]."""
    inverse, one = splat(grid.inverse[level]), splat(np.float32(1))
    for p in range(0, n, 8):
        px, py, pz = load(x, p) * inverse, load(x, pitch + p) * inverse, load(x, 2 * pitch + p) * inverse
        cx, cy, cz = floor(px), floor(py), floor(pz)
        fx, fy, fz = px - cx, py - cy, pz - cz
        k = corners(grid.levels, level, to_int(cx), to_int(cy), to_int(cz))
        a, b = load(d_enc, 2 * level * pitch + p), load(d_enc, (2 * level + 1) * pitch + p)
        gx, gy, gz = one - fx, one - fy, one - fz
        corner_pair(d_table, k[0], k[1], gx, fx, gy * gz, a, b)
        corner_pair(d_table, k[2], k[3], gx, fx, fy * gz, a, b)
        corner_pair(d_table, k[4], k[5], gx, fx, gy * fz, a, b)
        corner_pair(d_table, k[6], k[7], gx, fx, fy * fz, a, b)
