"""Triton kernels that average a frame into the fused TSDF volume: see ``fusion_views`` for what they compute."""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from . import fusion_views
from ._gpu_blocks import BITS, CELLS, EDGE, HALF, MASK, SCALE, block_key, enter
from ._gpu_points import camera_row, moved

MAX_WEIGHT, WEIGHT_STEPS = tl.constexpr(fusion_views.MAX_WEIGHT), tl.constexpr(fusion_views.WEIGHT_STEPS)
NEAREST_M = tl.constexpr(fusion_views.NEAREST_M)
BASELINE_M, STRIDE = tl.constexpr(fusion_views.NORMAL_BASELINE_M), tl.constexpr(fusion_views.NORMAL_STRIDE)
RED, GREEN, BLUE = tl.constexpr(9798), tl.constexpr(19235), tl.constexpr(3735)  # as OpenCV has them, over 2^15
ROUNDING = tl.constexpr(1.5 * 2**23)  # a float32 added to it and taken away again is rounded, ties to even
FX, FY, CX, CY = tl.constexpr(12), tl.constexpr(13), tl.constexpr(14), tl.constexpr(15)
NEAR, FAR, NOW, SWEEP, GAIN = tl.constexpr(16), tl.constexpr(17), tl.constexpr(18), tl.constexpr(19), tl.constexpr(25)


class Listed(NamedTuple):
    """Which blocks a frame touches. stamp: int32 [slots], the last frame that listed a block. slot: int32 [slots], the
    listed ones. counts: int32 [2], how many are listed, and how many slots of the table are taken."""

    stamp: Tensor
    slot: Tensor
    counts: Tensor


class View(NamedTuple):
    """One frame. depth: float32 [H, W] metres, 0 = none. light: float32 [H, W] in 0..1. normal: float32 [H / 2, W / 2,
    3] in the camera. numbers: float64 [26]: c2w [3, 4], fx, fy, cx, cy, near and far in metres, number of the frame,
    sweep [6] (see ``fusion_views.View``), gain of the luminance, which is cut off at 1."""

    depth: Tensor
    light: Tensor
    normal: Tensor
    numbers: Tensor
    height: int
    width: int


@triton.jit
def read_kernel(measured, color, view, listed, block: tl.constexpr):
    """Cut the measured depth [H, W] to near..far, turn colour uint8 [H, W, 3] into luminance, empty the list."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < view.height * view.width
    near, far = tl.load(view.numbers + NEAR).to(tl.float32), tl.load(view.numbers + FAR).to(tl.float32)
    depth = tl.load(measured + i, live, 0.0)
    tl.store(view.depth + i, tl.where((depth >= near) & (depth <= far), depth, 0.0), live)
    red = tl.load(color + 3 * i, live, 0).to(tl.int32)
    green = tl.load(color + 3 * i + 1, live, 0).to(tl.int32)
    blue = tl.load(color + 3 * i + 2, live, 0).to(tl.int32)
    gray = (red * RED + green * GREEN + blue * BLUE + (1 << 14)) >> 15
    gain = tl.load(view.numbers + GAIN).to(tl.float32)
    tl.store(view.light + i, tl.minimum(gray.to(tl.float32) * (gain / 255), 1.0), live)
    if tl.program_id(0) == 0:
        tl.store(listed.counts, 0)


@triton.jit
def depth_at(view, u, v, there):
    """Depth of pixels, float64 metres, 0 where there is none."""
    return tl.load(view.depth + v * view.width + u, there, 0.0).to(tl.float64)


@triton.jit
def normals_kernel(view, block: tl.constexpr):
    """See ``fusion_views.normals``."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    columns = (view.width + STRIDE - 1) // STRIDE
    live = i < (view.height + STRIDE - 1) // STRIDE * columns
    u, v = i % columns * STRIDE, i // columns * STRIDE
    fx, fy = tl.load(view.numbers + FX), tl.load(view.numbers + FY)
    cx, cy = tl.load(view.numbers + CX), tl.load(view.numbers + CY)
    x, y = (u - cx) / fx, (v - cy) / fy
    d = depth_at(view, u, v, live)
    there = live & (d > 0)
    k = tl.maximum((fx * BASELINE_M / tl.where(there, d, 1.0)).to(tl.int32), 1)
    there = there & (u >= k) & (v >= k) & (u + k < view.width) & (v + k < view.height)
    left, right = depth_at(view, u - k, v, there), depth_at(view, u + k, v, there)
    up, down = depth_at(view, u, v - k, there), depth_at(view, u, v + k, there)
    bend = 0.01 + 0.01 * d
    there = there & (left > 0) & (right > 0) & (up > 0) & (down > 0)
    there = there & (tl.abs(left + right - 2 * d) < bend) & (tl.abs(up + down - 2 * d) < bend)
    a0 = (u + k - cx) / fx * right - (u - k - cx) / fx * left
    a1, a2 = y * (right - left), right - left
    b0, b2 = x * (down - up), down - up
    b1 = (v + k - cy) / fy * down - (v - k - cy) / fy * up
    c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    norm = tl.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
    there = there & (norm > 1e-12)
    c0, c1, c2 = tl.where(there, c0, x), tl.where(there, c1, y), tl.where(there, c2, 1.0)
    scale = 1 / tl.where(there, norm, tl.sqrt(x * x + y * y + 1))
    scale = tl.where(c0 * x + c1 * y + c2 > 0, -scale, scale)
    tl.store(view.normal + 3 * i, (scale * c0).to(tl.float32), live)
    tl.store(view.normal + 3 * i + 1, (scale * c1).to(tl.float32), live)
    tl.store(view.normal + 3 * i + 2, (scale * c2).to(tl.float32), live)


@triton.jit
def load_sweep(view):
    """The six numbers of a sweep, float64."""
    at = view.numbers + SWEEP
    return tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3), tl.load(at + 4), tl.load(at + 5)


@triton.jit
def drift(s, x, y, z):
    """See ``fusion_views.drift``."""
    return s[0] + s[4] * z - s[5] * y, s[1] + s[5] * x - s[3] * z, s[2] + s[3] * y - s[4] * x


@triton.jit
def touch_kernel(blocks, listed, view, stride, steps, block: tl.constexpr):
    """Make and list the blocks within the truncation of the measured surface along every ``stride``-th pixel, a lane
    for each of ``steps`` points of such a ray. A block without a place is left to a later frame."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    step, pixel = i % steps, i // steps
    columns = (view.width - stride // 2 + stride - 1) // stride
    u, v = pixel % columns * stride + stride // 2, pixel // columns * stride + stride // 2
    d = depth_at(view, u, v, v < view.height)
    live = d > 0
    edge, reach = tl.load(blocks.lengths) * EDGE, tl.load(blocks.lengths + 1)
    z = d - reach + 2 * reach * step / (steps - 1)
    x = (u - tl.load(view.numbers + CX)) / tl.load(view.numbers + FX)
    y = (v - tl.load(view.numbers + CY)) / tl.load(view.numbers + FY)
    dx, dy, dz = drift(load_sweep(view), x * d, y * d, d)
    share = (v + 0.5).to(tl.float64) / view.height - 0.5
    x, y, z = x * z + share * dx, y * z + share * dy, z + share * dz
    bx = tl.floor(moved(view.numbers, (x, y, z), 0) / edge).to(tl.int64)
    by = tl.floor(moved(view.numbers, (x, y, z), 1) / edge).to(tl.int64)
    bz = tl.floor(moved(view.numbers, (x, y, z), 2) / edge).to(tl.int64)
    slot = enter(blocks, listed.counts + 1, block_key(bx, by, bz), live)
    now = tl.load(view.numbers + NOW).to(tl.int32)
    stale = (slot >= 0) & (tl.load(listed.stamp + slot, slot >= 0, 0) != now)
    last = tl.atomic_xchg(listed.stamp + slot, now + tl.full([block], 0, tl.int32), stale, sem="relaxed")
    first = stale & (last != now)
    place = tl.atomic_add(listed.counts + tl.full([block], 0, tl.int32), 1, first, sem="relaxed")
    tl.store(listed.slot + place, slot.to(tl.int32), first)


@triton.jit
def into_camera(rows, world, axis: tl.constexpr):
    """One camera coordinate of world vectors; rows: those of the camera's rotation."""
    return rows[0][axis] * world[0] + rows[1][axis] * world[1] + rows[2][axis] * world[2]


@triton.jit
def single(row):
    """Four numbers as float32."""
    return row[0].to(tl.float32), row[1].to(tl.float32), row[2].to(tl.float32), row[3].to(tl.float32)


@triton.jit
def single_sweep(view):
    """The six numbers of a sweep as float32."""
    s = load_sweep(view)
    return (
        s[0].to(tl.float32), s[1].to(tl.float32), s[2].to(tl.float32),
        s[3].to(tl.float32), s[4].to(tl.float32), s[5].to(tl.float32),
    )  # fmt: skip


@triton.jit
def nearest(x):
    """Float32 rounded to an integer, ties to even."""
    return (x + ROUNDING) - ROUNDING


@triton.jit
def add_view(blocks, view, slot):
    """Add a view to the block in ``slot``: see ``fusion_views.integrate``. Its corner is placed in the camera in
    float64, the rest is float32."""
    voxel, truncation = tl.load(blocks.lengths), tl.load(blocks.lengths + 1).to(tl.float32)
    rows = camera_row(view.numbers, 0), camera_row(view.numbers, 1), camera_row(view.numbers, 2)
    key = tl.load(blocks.keys + slot)
    ox = ((key >> (2 * BITS)) - HALF) * EDGE * voxel - rows[0][3]
    oy = (((key >> BITS) & MASK) - HALF) * EDGE * voxel - rows[1][3]
    oz = ((key & MASK) - HALF) * EDGE * voxel - rows[2][3]
    cell = tl.arange(0, CELLS)
    step = voxel.to(tl.float32)
    within = (cell & 7) * step, ((cell >> 3) & 7) * step, (cell >> 6) * step
    turned = single(rows[0]), single(rows[1]), single(rows[2])
    x = into_camera(rows, (ox, oy, oz), 0).to(tl.float32) + into_camera(turned, within, 0)
    y = into_camera(rows, (ox, oy, oz), 1).to(tl.float32) + into_camera(turned, within, 1)
    z = into_camera(rows, (ox, oy, oz), 2).to(tl.float32) + into_camera(turned, within, 2)
    fx, fy, cx, cy = single(
        (
            tl.load(view.numbers + FX),
            tl.load(view.numbers + FY),
            tl.load(view.numbers + CX),
            tl.load(view.numbers + CY),
        )
    )
    share = (fy * y / tl.maximum(z, NEAREST_M) + cy + 0.5) / view.height - 0.5
    share = tl.minimum(tl.maximum(share, -0.5), 0.5)
    dx, dy, dz = drift(single_sweep(view), x, y, z)
    x, y, z = x - share * dx, y - share * dy, z - share * dz
    there = z > NEAREST_M
    ahead = tl.where(there, z, 1.0)
    right, low = tl.floor(fx * x / ahead + cx + 0.5), tl.floor(fy * y / ahead + cy + 0.5)
    there = there & (right >= 0) & (low >= 0) & (right < view.width) & (low < view.height)
    u, v = tl.where(there, right, 0.0).to(tl.int32), tl.where(there, low, 0.0).to(tl.int32)
    d = tl.load(view.depth + v * view.width + u, there, 0.0)
    there = there & (d > 0) & (d >= z - 2 * truncation)
    columns = (view.width + STRIDE - 1) // STRIDE
    normal = view.normal + 3 * (v // STRIDE * columns + u // STRIDE)
    n0, n1, n2 = tl.load(normal, there, 0.0), tl.load(normal + 1, there, 0.0), tl.load(normal + 2, there, 0.0)
    px, py = (u - cx) / fx * d, (v - cy) / fy * d
    s = (n0 * (x - px) + n1 * (y - py) + n2 * (z - d)) / truncation
    s = tl.where(d - z > 2 * truncation, 1.0, s)
    there = there & (s >= -1)
    facing = -(n0 * px + n1 * py + n2 * d) / tl.sqrt(tl.where(there, px * px + py * py + d * d, 1.0))
    added = tl.floor(tl.maximum(facing, 0.0) * WEIGHT_STEPS / tl.maximum(d * d, 1.0) + 0.5)
    added = tl.maximum(added, 1.0)
    at = blocks.voxels + slot * (3 * CELLS) + 3 * cell
    held = tl.load(at + 2, there, 0).to(tl.float32)
    share = added / (held + added)
    distance = tl.load(at, there, 0).to(tl.float32)
    distance += nearest(share * (tl.minimum(s, 1.0) * SCALE - distance))
    tl.store(at, distance.to(tl.int16), there)
    lit = there & (tl.abs(s) < 1)
    light = tl.load(at + 1, lit, 0).to(tl.float32)
    light += nearest(share * (tl.load(view.light + v * view.width + u, lit, 0.0) * SCALE - light))
    tl.store(at + 1, light.to(tl.int16), lit)
    tl.store(at + 2, tl.minimum(held + added, MAX_WEIGHT).to(tl.int16), there)


@triton.jit
def integrate_kernel(blocks, listed, view):
    """Add a view to all listed blocks; a program takes every n-th."""
    for n in range(tl.program_id(0), tl.load(listed.counts), tl.num_programs(0)):
        add_view(blocks, view, tl.load(listed.slot + n).to(tl.int64))
