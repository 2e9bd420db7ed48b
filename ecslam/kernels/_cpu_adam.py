"""A step of Adam for the map, jitted."""

from __future__ import annotations

import numpy as np
from numba import njit

from ._cpu_math import INNER, WORKER


@njit(**INNER)
def adam_range(parameter, gradient, mean, square, numbers, start, stop):
    """See ``reference.map_step``, of the numbers from ``start`` to ``stop`` of a parameter. numbers: float32 [5], the
    learning rate over the first moment's correction, the root of the second one's, both decays and epsilon."""
    rate, root, first, second, epsilon = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    p, g, m, v = parameter[start:stop], gradient[start:stop], mean[start:stop], square[start:stop]
    for i in range(stop - start):
        m[i] = first * m[i] + (np.float32(1) - first) * g[i]
        v[i] = second * v[i] + (np.float32(1) - second) * g[i] * g[i]
        p[i] -= rate * m[i] / (np.sqrt(v[i]) / root + epsilon)


@njit(**WORKER)
def adam_worker(parameter, gradient, mean, square, numbers):
    """``adam_range`` of all of them."""
    adam_range(parameter, gradient, mean, square, numbers, 0, parameter.shape[0])
