"""The encoding as Triton code: hash grid and one-blob of a block of points, and the way back, in registers.

A tile [points, levels] holds one feature of every level, so nothing loops over levels, and both features of a table
row are one load. Cells are found as if in float64: a position is a float32 and what rounding lost, so a point never
lands in the neighbouring cell.
"""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

PRIME_Y = tl.constexpr(-1640531535)  # 2654435761 as int32
PRIME_Z = tl.constexpr(805459861)


class Field(NamedTuple):
    """What the kernels read. levels: int32 [L, 8] (offset, size - 1, first, dims); inverse: float32 [L, 2], one over
    the voxel and what rounding lost; geometry: float64 [15] (anchor, blob low, 1 / blob size, box low, box high); the
    rest as in ``FieldParams``."""

    levels: Tensor
    inverse: Tensor
    geometry: Tensor
    table: Tensor
    w_in: Tensor
    w_sdf: Tensor
    w_rgb: Tensor


class Shape(NamedTuple):
    """Sizes known when a kernel is compiled. width, blobs: levels and the bins of all three axes, padded to a power of
    two; 2 width and blobs are at least 16, the least that a matrix product takes."""

    levels: int
    width: int
    bins: int
    blobs: int


@triton.jit
def on_box(field, world, axis: tl.constexpr, shape: tl.constexpr):
    """One coordinate, float64 [P]: its distance from the anchor as float32 and what rounding lost, its one-blob phase
    in bins, and 1 if it was inside the box, else 0."""
    at = field.geometry + axis
    low, high = tl.load(at + 9), tl.load(at + 12)
    x = tl.minimum(tl.maximum(world, low), high)
    period = (x - tl.load(at + 3)) * tl.load(at + 6)
    near = x - tl.load(at)
    rounded = near.to(tl.float32)
    lost = (near - rounded.to(tl.float64)).to(tl.float32)
    phase = ((period - tl.floor(period)) * shape.bins).to(tl.float32)
    return rounded, lost, phase, (x == world).to(tl.float32)


@triton.jit
def locate(field, x, rest, level, axis: tl.constexpr, prime: tl.constexpr, shape: tl.constexpr):
    """One axis of points at levels, tiles that broadcast: the fraction within the cell, and what the two lattice points
    around it add to a row number (a stride times the place where a level is dense, a factor of the hash where not)."""
    known = level < shape.levels
    inverse = tl.load(field.inverse + 2 * level, known, 0.0)
    correction = tl.load(field.inverse + 2 * level + 1, known, 0.0)
    wide = x + tl.zeros_like(inverse)
    cell = tl.floor(wide * inverse)
    fraction = tl.fma(wide, inverse + tl.zeros_like(wide), -cell) + (rest * inverse + wide * correction)
    over = tl.floor(fraction)
    at = field.levels + 8 * level
    first = tl.load(at + 2 + axis, known, 0)
    last = tl.load(at + 5 + axis, known, 0) - 1
    stride = tl.full(level.shape, 1, tl.int32)
    if axis >= 1:
        stride *= tl.load(at + 5, known, 0)
    if axis == 2:
        stride *= tl.load(at + 6, known, 0)
    k = (cell + over).to(tl.int32)
    near = tl.minimum(tl.maximum(k - first, 0), last) * stride
    far = tl.minimum(tl.maximum(k + 1 - first, 0), last) * stride
    dense = last >= 0
    return fraction - over, (tl.where(dense, near, k * prime), tl.where(dense, far, (k + 1) * prime))


@triton.jit
def row_of(field, x, y, z, level, shape: tl.constexpr):
    """Table rows at levels, from what the places along the three axes add."""
    known = level < shape.levels
    at = field.levels + 8 * level
    offset, mask, dense = tl.load(at, known, 0), tl.load(at + 1, known, 0), tl.load(at + 5, known, 0) > 0
    return offset + tl.where(dense, x + y + z, (x ^ y ^ z) & mask)


@triton.jit
def corner(field, x, y, z, live, shape: tl.constexpr):
    """The two features of one corner at all levels: even [P, width], odd [P, width]."""
    level = tl.arange(0, shape.width)[None, :]
    at = 2 * row_of(field, x, y, z, level, shape)[:, :, None] + tl.arange(0, 2)[None, None, :]
    there = live[:, None] & (level < shape.levels)
    return tl.split(tl.load(field.table + at, there[:, :, None], 0.0))


@triton.jit
def gather(field, at, fraction, live, shape: tl.constexpr):
    """Trilinear features of all levels, even [P, width] and odd [P, width], and the derivatives of either by the
    fractions (x, y, z)."""
    fx, fy, fz = fraction
    even, odd = tl.zeros_like(fx), tl.zeros_like(fx)
    even_x, even_y, even_z = even, even, even
    odd_x, odd_y, odd_z = even, even, even
    for c in tl.static_range(4):
        wy = fy if c % 2 else 1 - fy
        wz = fz if c // 2 else 1 - fz
        even_0, odd_0 = corner(field, at[0][0], at[1][c % 2], at[2][c // 2], live, shape)
        even_1, odd_1 = corner(field, at[0][1], at[1][c % 2], at[2][c // 2], live, shape)
        along_even, along_odd = even_1 - even_0, odd_1 - odd_0
        middle_even, middle_odd = even_0 + fx * along_even, odd_0 + fx * along_odd
        even += wy * wz * middle_even
        odd += wy * wz * middle_odd
        even_x += wy * wz * along_even
        odd_x += wy * wz * along_odd
        even_y += (wz if c % 2 else -wz) * middle_even
        odd_y += (wz if c % 2 else -wz) * middle_odd
        even_z += (wy if c // 2 else -wy) * middle_even
        odd_z += (wy if c // 2 else -wy) * middle_odd
    return even, odd, (even_x, even_y, even_z), (odd_x, odd_y, odd_z)


@triton.jit
def pull(field, at, fraction, d_even, d_odd, live, shape: tl.constexpr):
    """Gradient by the position x, y, z, per metre [P] each, from that of the features. Reads the table again: the
    cache still has it, and the six derivatives kept instead would not fit the registers."""
    fx, fy, fz = fraction
    gx, gy, gz = tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx)
    for c in tl.static_range(4):
        wy = fy if c % 2 else 1 - fy
        wz = fz if c // 2 else 1 - fz
        even_0, odd_0 = corner(field, at[0][0], at[1][c % 2], at[2][c // 2], live, shape)
        even_1, odd_1 = corner(field, at[0][1], at[1][c % 2], at[2][c // 2], live, shape)
        start = even_0 * d_even + odd_0 * d_odd
        across = even_1 * d_even + odd_1 * d_odd - start
        middle = start + fx * across
        gx += wy * wz * across
        gy += (wz if c % 2 else -wz) * middle
        gz += (wy if c // 2 else -wy) * middle
    level = tl.arange(0, shape.width)
    inverse = tl.load(field.inverse + 2 * level, level < shape.levels, 0.0)[None, :]
    return tl.sum(gx * inverse, 1), tl.sum(gy * inverse, 1), tl.sum(gz * inverse, 1)


@triton.jit
def rise(t):
    """Integral of the quartic kernel from -1 to t."""
    t = tl.minimum(tl.maximum(t, -1.0), 1.0)
    return 0.9375 * t * (1 - t * t * (2 / 3 - 0.2 * t * t)) + 0.5


@triton.jit
def quartic(t):
    """The kernel itself."""
    rest = tl.maximum(1 - t * t, 0.0)
    return 0.9375 * rest * rest


@triton.jit
def axis_of(shape: tl.constexpr):
    """Which axis each column of a one-blob tile belongs to [blobs]; 3 or more: none."""
    return tl.arange(0, shape.blobs) // shape.bins


@triton.jit
def one_blob(phase, shape: tl.constexpr):
    """One-blob values [P, blobs], axis after axis, and their derivatives by the phases; four bins or more, so that the
    kernel meets each bin once."""
    axis = axis_of(shape)[None, :]
    middle = (tl.arange(0, shape.blobs) % shape.bins)[None, :] + 0.5
    t = middle - tl.where(axis == 0, phase[0][:, None], tl.where(axis == 1, phase[1][:, None], phase[2][:, None]))
    t = tl.where(t > shape.bins / 2, t - shape.bins, t)
    t = tl.where(t < -shape.bins / 2, t + shape.bins, t)
    value = tl.where(axis < 3, rise(t + 0.5) - rise(t - 0.5), 0.0)
    return value, tl.where(axis < 3, quartic(t - 0.5) - quartic(t + 0.5), 0.0)


@triton.jit
def place(field, x, rest, shape: tl.constexpr):
    """Points at distances from the anchor and what rounding lost (x, y, z: [P] each), at all levels [P, width]: what
    their corners add to row numbers, and fractions within the cells."""
    level = tl.arange(0, shape.width)[None, :]
    fx, at_x = locate(field, x[0][:, None], rest[0][:, None], level, 0, 1, shape)
    fy, at_y = locate(field, x[1][:, None], rest[1][:, None], level, 1, PRIME_Y, shape)
    fz, at_z = locate(field, x[2][:, None], rest[2][:, None], level, 2, PRIME_Z, shape)
    return (at_x, at_y, at_z), (fx, fy, fz)
