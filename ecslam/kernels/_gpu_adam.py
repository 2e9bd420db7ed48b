"""A step of Adam for the map's parameters as one Triton kernel that keeps the whole GPU busy."""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor


class Learnt(NamedTuple):
    """A parameter of ``size`` numbers, its gradient and its moments."""

    parameter: Tensor
    gradient: Tensor
    mean: Tensor
    square: Tensor
    size: int


@triton.jit
def lost(count, logarithm):
    """1 - decay**count, from the logarithm of the decay; by its series where little is lost, as the difference from 1
    would then have few digits."""
    x = -count * logarithm
    series = x * (1 - x / 2 * (1 - x / 3 * (1 - x / 4 * (1 - x / 5 * (1 - x / 6 * (1 - x / 7))))))
    return tl.where(x < 0.5, series, 1 - tl.exp(-x))


@triton.jit
def adam_kernel(
    learnt, count_at, rate, keep, add, logarithms, epsilon, rate_is_number: tl.constexpr, block: tl.constexpr
):
    """See ``reference.map_step``; a program takes one block of every parameter. learnt: tuple of ``Learnt``; rate: a
    number or where it is; keep, add, logarithms: for either moment its decay, one less that, and its logarithm."""
    count = tl.load(count_at)
    step = (rate if rate_is_number else tl.load(rate)) / lost(count, logarithms[0])
    root = tl.sqrt(lost(count, logarithms[1]))
    for k in tl.static_range(len(learnt)):
        one = learnt[k]
        i = tl.program_id(0) * block + tl.arange(0, block)
        live = i < one.size
        gradient = tl.load(one.gradient + i, live, 0.0)
        mean = keep[0] * tl.load(one.mean + i, live, 0.0) + add[0] * gradient
        square = keep[1] * tl.load(one.square + i, live, 0.0) + add[1] * gradient * gradient
        before = tl.load(one.parameter + i, live, 0.0)
        tl.store(one.mean + i, mean, live)
        tl.store(one.square + i, square, live)
        tl.store(one.parameter + i, before - step * mean / (tl.sqrt(square) / root + epsilon), live)
