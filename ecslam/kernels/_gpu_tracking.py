"""Triton kernels around the alignment of a frame: its points, which of them take part, what came of it, and the pixels
that are rendered from there on.

Each is one launch where torch would take dozens, and what a launch costs is what such small work costs on a GPU.
"""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from ._gpu_descent import COUNT, WIDTH
from ._gpu_points import moved
from .reference import PRIMES

SECOND, THIRD = tl.constexpr(PRIMES[1]), tl.constexpr(PRIMES[2])


class Cells(NamedTuple):
    """A uniform grid of cells over an image ``width`` pixels wide, inside a ``border``. bottom, right: the last row and
    column of pixels inside, from the border on; step_v, step_u: pixels from one cell to the next."""

    width: int
    border: int
    columns: int
    bottom: int
    right: int
    step_v: float
    step_u: float


class Marks(NamedTuple):
    """Where the map has been observed. marks: uint8 [slots], 1 at the hashes of observed voxels. slots: a power of two.
    per_metre: voxels in a metre; the processor divides float64 by calling a function, so it multiplies."""

    marks: Tensor
    slots: int
    per_metre: float


class Lens(NamedTuple):
    """Focal lengths and principal point in pixels; which depths count, in metres."""

    fx: float
    fy: float
    cx: float
    cy: float
    near: float
    far: float


@triton.jit
def pixel_in(cells, cell, along_v, along_u):
    """Column and row of the pixel at a share, 0..1 each way, of each cell."""
    v = (((cell // cells.columns).to(tl.float32) + along_v) * cells.step_v).to(tl.int32)
    u = (((cell % cells.columns).to(tl.float32) + along_u) * cells.step_u).to(tl.int32)
    return tl.minimum(u, cells.right) + cells.border, tl.minimum(v, cells.bottom) + cells.border


@triton.jit
def depth_in_range(depth, at, lens, live):
    """Measured depth of pixels, 0 where there is none that counts."""
    d = tl.load(depth + at, live, 0.0)
    return tl.where((d >= lens.near) & (d <= lens.far), d, 0.0)


@triton.jit
def spread_kernel(depth, color, jitter, points, cells, lens, luminance, gain, total, block: tl.constexpr):
    """A pixel in each of ``total`` cells as a row of ``points`` float32 [N, 4]: camera coordinates, all 0 without a
    depth, and luminance. jitter: [N, 2] in 0..1; luminance: of red, green and blue in 0..255; gain: of it, float64,
    up to 1."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < total
    u, v = pixel_in(cells, i, tl.load(jitter + 2 * i, live, 0.0), tl.load(jitter + 2 * i + 1, live, 0.0))
    at = v * cells.width + u
    d = depth_in_range(depth, at, lens, live)
    light = tl.zeros_like(d)
    for k in tl.static_range(3):
        light += tl.load(color + 3 * at + k, live, 0).to(tl.float32) * luminance[k]
    tl.store(points + 4 * i, (u - lens.cx) / lens.fx * d, live)
    tl.store(points + 4 * i + 1, (v - lens.cy) / lens.fy * d, live)
    tl.store(points + 4 * i + 2, d, live)
    tl.store(points + 4 * i + 3, tl.minimum(light * tl.load(gain).to(tl.float32), 1.0), live)


@triton.jit
def seen(points, distance, first, total, block: tl.constexpr):
    """Of points from ``first`` on: their places, which are measured, which of these lie where the surface is known, and
    how far from it."""
    i = first + tl.arange(0, block)
    live = i < total
    has = live & (tl.load(points + 4 * i + 2, live, 0.0) > 0)
    d = tl.load(distance + i, live, float("nan"))
    return i, has, has & (d == d), d


@triton.jit
def pack_kernel(points, distance, c2w, packed, row, total, least, block: tl.constexpr):
    """Put the points [N, 4] that are to be aligned one after another: those with a ``distance`` [N], all that are
    measured where these are fewer than ``least``. row: takes the pose c2w [4, 4] and how many they are. One program."""
    known = tl.full([], 0, tl.int32)
    for first in range(0, total, block):
        _, _, there, _ = seen(points, distance, first, total, block)
        known += tl.sum(there.to(tl.int32))
    count = tl.full([], 0, tl.int32)
    for first in range(0, total, block):
        i, has, there, _ = seen(points, distance, first, total, block)
        keep = tl.where(known < least, has, there)
        place = count + tl.cumsum(keep.to(tl.int32), 0) - 1
        for k in tl.static_range(4):
            tl.store(packed + 4 * place + k, tl.load(points + 4 * i + k, keep, 0.0), keep)
        count += tl.sum(keep.to(tl.int32))
    i = tl.arange(0, 128)
    number = tl.where(i == COUNT, count.to(tl.float64), tl.load(c2w + i, i < 12, 0.0))
    tl.store(row + i, number, i < WIDTH)


@triton.jit
def told_kernel(points, distance, c2w, cost, count, told, total, near, least_seen, block: tl.constexpr):
    """What is told of a pose: c2w [3, 4], ``cost`` over ``count`` points, share of the known points ``near`` the
    surface (0 where too few of the measured ones are known), how many are measured. One program."""
    none = tl.full([], 0, tl.int32)
    measured, known, close = none, none, none
    for first in range(0, total, block):
        _, has, there, d = seen(points, distance, first, total, block)
        measured += tl.sum(has.to(tl.int32))
        known += tl.sum(there.to(tl.int32))
        close += tl.sum((there & (tl.abs(d) < near)).to(tl.int32))
    fit = close.to(tl.float64) / tl.maximum(known, 1)
    fit = tl.where(known < least_seen * tl.maximum(measured, 1), 0.0, fit)
    i = tl.arange(0, 16)
    number = tl.load(c2w + i, i < 12, 0.0)
    number = tl.where(i == 12, tl.load(cost) / tl.maximum(tl.load(count), 1.0), number)
    number = tl.where(i == 13, fit, tl.where(i == 14, measured.to(tl.float64), number))
    tl.store(told + i, number, i < 15)


@triton.jit
def is_observed(observed, x, y, z):
    """Whether world points (float64 metres) lie in a marked voxel."""
    kx, ky = tl.floor(x * observed.per_metre).to(tl.int64), tl.floor(y * observed.per_metre).to(tl.int64)
    kz = tl.floor(z * observed.per_metre).to(tl.int64)
    return tl.load(observed.marks + ((kx ^ (ky * SECOND) ^ (kz * THIRD)) & (observed.slots - 1))) != 0


@triton.jit
def choose_kernel(
    depth, color, jitter, pitch, corners, order, observed, c2w, chosen, known, cells, lens, features, grid, total,
    gridded: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """A pixel for each row of ``jitter`` [N, 3], rows ``pitch`` apart: the first ``features`` are the ``corners`` where
    these are not -1; the others, if ``gridded``, lie in cells of the shuffled ``order`` [grid], else anywhere. known:
    whether their points, seen from c2w, lie where the map has been ``observed``."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < total
    cell = tl.zeros_like(i)
    if gridded:
        begin = (tl.load(jitter + 2) * grid).to(tl.int32)
        cell = tl.load(order + (i + begin) % grid, live, 0).to(tl.int32)
    down, right = tl.load(jitter + pitch * i, live, 0.0), tl.load(jitter + pitch * i + 1, live, 0.0)
    u, v = pixel_in(cells, cell, down, right)
    corner = tl.load(corners + i, live & (i < features), -1).to(tl.int32)
    feature = corner >= 0
    at = tl.where(feature, corner, v * cells.width + u)
    u, v = at % cells.width, at // cells.width
    d = depth_in_range(depth, at, lens, live)
    x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
    local = (x * d).to(tl.float64), (y * d).to(tl.float64), d.to(tl.float64)
    there = is_observed(observed, moved(c2w, local, 0), moved(c2w, local, 1), moved(c2w, local, 2))
    tl.store(chosen.direction + 3 * i, x, live)
    tl.store(chosen.direction + 3 * i + 1, y, live)
    tl.store(chosen.direction + 3 * i + 2, tl.full(x.shape, 1.0, tl.float32), live)
    tl.store(chosen.depth + i, d, live)
    for k in tl.static_range(3):
        tl.store(chosen.color + 3 * i + k, tl.load(color + 3 * at + k, live, 0), live)
    tl.store(chosen.feature + i, feature.to(tl.uint8), live)
    tl.store(known + i, (there & (d > 0)).to(tl.uint8), live)


@triton.jit
def copy_row(chosen, i, kept, place, mask):
    """Copy pixels ``i`` to ``place``, where ``mask`` is set."""
    for k in tl.static_range(3):
        tl.store(kept.direction + 3 * place + k, tl.load(chosen.direction + 3 * i + k, mask, 0.0), mask)
        tl.store(kept.color + 3 * place + k, tl.load(chosen.color + 3 * i + k, mask, 0), mask)
    tl.store(kept.depth + place, tl.load(chosen.depth + i, mask, 0.0), mask)
    tl.store(kept.feature + place, tl.load(chosen.feature + i, mask, 0), mask)


@triton.jit
def keep_kernel(chosen, known, kept, total, least, block: tl.constexpr):
    """As many pixels [N] again, all of them ``known``, in turn; all that are measured take part where these are fewer
    than ``least``, and the first one alone where none is. One program."""
    measured, there = tl.full([], 0, tl.int32), tl.full([], 0, tl.int32)
    for first in range(0, total, block):
        i = first + tl.arange(0, block)
        measured += tl.sum((tl.load(chosen.depth + i, i < total, 0.0) > 0).to(tl.int32))
        there += tl.sum(tl.load(known + i, i < total, 0).to(tl.int32))
    count = tl.where(there < least, measured, there)
    before = tl.full([], 0, tl.int32)
    for first in range(0, total, block):
        i = first + tl.arange(0, block)
        has = tl.load(chosen.depth + i, i < total, 0.0) > 0
        keep = tl.where(there < least, has, tl.load(known + i, i < total, 0) != 0)
        keep = tl.where(count == 0, i == 0, keep)
        place = before + tl.cumsum(keep.to(tl.int32), 0) - 1
        for turn in range(0, total, tl.maximum(count, 1)):
            copy_row(chosen, i, kept, place + turn, keep & (place + turn < total))
        before += tl.sum(keep.to(tl.int32))
