"""Elementary functions and sums on vectors of eight, jitted."""

from __future__ import annotations

import numpy as np
from numba import njit

from ._cpu_simd import floor, fma, fold, highest, load, load16, lowest, power_of_two, row_sums, splat

OUTER = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp", "reassoc"}, "cache": True}
# Without counts of references to the arrays passed in: they are atomic, so each stops the processor from reading ahead.
# Such functions cannot make arrays.
WORKER = {**OUTER, "_nrt": False}
# What is not inlined is compiled for itself and with each caller, and which of the two runs depends on whether the
# caller was read from disk: they need not round alike.
PART = {**WORKER, "cache": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
INNER = {**PART, "forceinline": True}
BOTH = 64
HALF = 32


@njit(**INNER)
def dot(a, i, b, j):
    """Lane-wise partial sums of the dot product of two rows of 32."""
    return fold(load16(a, i) * load16(b, j) + load16(a, i + 16) * load16(b, j + 16))


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
def eight_sums(a, i):
    """The sums of eight consecutive rows of eight."""
    return row_sums(
        load(a, i), load(a, i + 8), load(a, i + 16), load(a, i + 24),
        load(a, i + 32), load(a, i + 40), load(a, i + 48), load(a, i + 56),
    )  # fmt: skip
