"""Depths along rays, jitted, float32 throughout: the same bits as ``reference_depths`` finds with dozens of tensors."""

from __future__ import annotations

import numpy as np
from numba import njit

EXACT = {"nogil": True, "error_model": "numpy", "cache": True}  # torch does not contract products and sums either
HALF, LEAST_DENSITY, LEAST_STEP = np.float32(0.5), np.float32(1e-5), np.float32(1e-8)


@njit(**EXACT)
def insert(row, filled, value):
    """Put a value among the first ``filled`` of a row, which ascend."""
    while filled > 0 and row[filled - 1] > value:
        row[filled] = row[filled - 1]
        filled -= 1
    row[filled] = value


@njit(**EXACT)
def merge(row, filled, more):
    """Put ascending values among the first ``filled`` of a row, which ascend too."""
    k = more.shape[0] - 1
    while k >= 0:
        if filled > 0 and row[filled - 1] > more[k]:
            row[filled + k] = row[filled - 1]
            filled -= 1
        else:
            row[filled + k] = more[k]
            k -= 1


@njit(**EXACT)
def sample_rows(depth, far, jitter, uniform, near, reach, z):
    """See ``reference_depths.sample_depths``: [R, S] into ``z``."""
    rays, samples = jitter.shape
    n_u, n_d = np.float32(max(uniform, 1)), np.float32(max(samples - uniform, 1))
    around = np.empty(samples - uniform, np.float32)
    for r in range(rays):
        end, start = far[r], near
        if depth[r] > 0:
            end, start = depth[r] + reach, max(depth[r] - reach, near)
        for j in range(uniform):
            insert(z[r], j, near + (end - near) * ((np.float32(j) + jitter[r, j]) / n_u))
        for j in range(samples - uniform):
            insert(around, j, start + (end - start) * ((np.float32(j) + jitter[r, uniform + j]) / n_d))
        merge(z[r], uniform, around)


@njit(**EXACT)
def importance_rows(z, weights, total, jitter, out):
    """See ``reference_depths.importance_depths``: into ``out`` [R, S + K]. total: [R], sums of the rays' densities."""
    samples, count = z.shape[1], jitter.shape[1]
    share, more = np.empty(samples - 1, np.float32), np.empty(count, np.float32)
    share[0] = 0
    for r in range(z.shape[0]):
        passed = 0.0
        for j in range(1, samples - 1):
            passed += (weights[r, j] + LEAST_DENSITY) / total[r]
            share[j] = passed
        right = 1
        for k in range(count):
            u = (np.float32(k) + jitter[r, k]) / np.float32(count)
            while right < samples - 2 and share[right] <= u:
                right += 1
            first, last = HALF * (z[r, right] + z[r, right - 1]), HALF * (z[r, right + 1] + z[r, right])
            step = max(share[right] - share[right - 1], LEAST_STEP)
            insert(more, k, first + (u - share[right - 1]) / step * (last - first))
        out[r, :samples] = z[r]
        merge(out[r], samples, more)
