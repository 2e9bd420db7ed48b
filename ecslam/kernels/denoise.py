"""The loop that smooths depth (numba), laid out so that it goes over several pixels of a row at once: without branches
and without sums along the row, so in plain float32."""

from __future__ import annotations

import numpy as np
from numba import njit

RADIUS = 3
OFFSETS = np.array(
    [(v, u) for v in range(RADIUS + 1) for u in range(-RADIUS, RADIUS + 1) if (v, u) > (0, 0)]
)  # [K, 2] rows and columns to one of each pair of pixels


@njit(nogil=True, cache=True, error_model="numpy")
def smooth(depth, tolerance, out):
    """The mean of inverse depth over a pixel and the pairs of pixels about it, one opposite the other, whose own mean
    agrees with it: they differ from it by less than ``tolerance`` (1/m) together. depth: float32 [H, W] metres, 0 =
    none; out: the same.

    Without depth the inverse is infinite and agrees with nothing, so such pixels join no mean and keep their 0.
    """
    height, width = depth.shape
    zero, one, two, most = np.float32(0), np.float32(1), np.float32(2), np.float32(tolerance)
    inverse = one / depth
    bends, count = np.empty(width, np.float32), np.empty(width, np.float32)
    for v in range(height):
        bends[:], count[:] = zero, one
        for i in range(OFFSETS.shape[0]):
            dv, du = OFFSETS[i]
            if dv > v or dv >= height - v:
                continue
            inset = abs(du)
            one_side, other_side = inverse[v + dv, inset + du :], inverse[v - dv, inset - du :]
            middle, total, number = inverse[v, inset:], bends[inset:], count[inset:]
            for u in range(width - 2 * inset):
                bend = one_side[u] + other_side[u] - two * middle[u]
                agrees = abs(bend) < most
                total[u] += bend if agrees else zero
                number[u] += two if agrees else zero
        for u in range(width):
            out[v, u] = depth[v, u] / (one + depth[v, u] * (bends[u] / count[u]))
