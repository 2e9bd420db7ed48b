"""The smoothness term's gradient, jitted: a level belongs to one thread at a time, so nothing is atomic."""

from __future__ import annotations

import numpy as np
from numba import njit

from ._cpu_back import next_level, table_back
from ._cpu_field import ANCHOR, corners, interpolate, locate
from ._cpu_math import INNER, OUTER, WORKER
from ._cpu_simd import store


@njit(**INNER)
def level_features(grid, level, table, x, n, rows, feature):
    """Both features [2 n] of one level at points x [6, n]; n is a multiple of 8."""
    for p in range(0, n, 8):
        ix, iy, iz, fx, fy, fz = locate(grid, level, x, p, n)
        corners(grid.levels, level, ix, iy, iz, rows, 0)
        first, second = interpolate(table, rows, 0, fx, fy, fz)[0]
        store(feature, p, first)
        store(feature, n + p, second)


@njit(**INNER)
def differences_back(feature, side, start, d_feature):
    """Gradient of the mean squared difference of neighbours in a lattice [side]^3 that begins at ``start``."""
    scale = np.float32(2 / side**3)
    for axis in range(3):
        stride = side ** (2 - axis)
        for block in range(0, side**3, stride * side):
            for i in range(start + block, start + block + stride * (side - 1)):
                d = scale * (feature[i + stride] - feature[i])
                d_feature[i + stride] += d
                d_feature[i] -= d


@njit(**OUTER)
def from_anchor(grid, points, x):
    """Points [N, 3] from the anchor on: rounded, and what rounding lost, in x [6, n >= N]."""
    n = x.shape[0] // 6
    x[:] = 0
    for axis in range(3):
        for i in range(points.shape[0]):
            exact = np.float64(points[i, axis]) - grid.geometry[ANCHOR + axis]
            x[axis * n + i] = exact
            x[(3 + axis) * n + i] = exact - np.float64(x[axis * n + i])


@njit(**WORKER)
def smooth_worker(t, counter, scratch, grid, table, x, side, d_table):
    """Gradient of the whole table; scratch: float32 [threads, 4 n + TABLE_SCRATCH]."""
    n = x.shape[0] // 6
    feature, d_feature, rest = scratch[t, : 2 * n], scratch[t, 2 * n : 4 * n], scratch[t, 4 * n :]
    rows = rest[:64].view(np.int32)  # read before ``table_back`` writes there
    while True:
        level = next_level(counter, grid, d_table)
        if level < 0:
            break
        level_features(grid, level, table, x, n, rows, feature)
        d_feature[:] = 0
        for k in range(2):
            differences_back(feature, side, k * n, d_feature)
        table_back(grid, level, x, d_feature, 0, n, n, rest, d_table)
