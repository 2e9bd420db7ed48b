"""Triton code for the blocks of the fused TSDF volume: finding and entering them in the hash table, and sampling.

A block's voxels lie at its key's slot of the table, so an inserted key is all that programs have to agree about. Keys
are never removed: a stale EMPTY costs a look with an atomic, and nothing else can be stale.
"""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from . import fusion
from ._gpu_points import moved, triple

EDGE, CELLS = tl.constexpr(fusion.EDGE), tl.constexpr(fusion.CELLS)
SCALE = tl.constexpr(fusion.SCALE)
EMPTY, NEVER = tl.constexpr(int(fusion.EMPTY)), tl.constexpr(-2)
BITS, HALF, MASK = tl.constexpr(fusion.BITS), tl.constexpr(fusion.HALF), tl.constexpr(fusion.MASK)
MIX = tl.constexpr(-7046029254386353131)  # 0x9E3779B97F4A7C15 as int64
PROBES = tl.constexpr(128)


class Blocks(NamedTuple):
    """keys: int64 [slots], the hash table, EMPTY where free. voxels: int16 [slots, 512, 3], x fastest: distance,
    luminance, weight. lengths: float64 [2], voxel and truncation in metres. slots: a power of two."""

    keys: Tensor
    voxels: Tensor
    lengths: Tensor
    slots: int


@triton.jit
def some(mask):
    """Whether any element is true."""
    return tl.max(mask.to(tl.int32)) > 0


@triton.jit
def block_key(x, y, z):
    """Keys of the blocks at integer block coordinates, int64."""
    return ((x + HALF) << (2 * BITS)) | ((y + HALF) << BITS) | (z + HALF)


@triton.jit
def home(blocks, key):
    """The slot where the search for a key begins."""
    return ((key * MIX) >> 32) & (blocks.slots - 1)


@triton.jit
def find(blocks, key, live):
    """The slots of keys, -1 where there is none."""
    slot = home(blocks, key)
    found = tl.full(key.shape, -1, tl.int64)
    left = live
    probes = 0
    while some(left) & (probes < PROBES):
        held = tl.load(blocks.keys + slot, left, EMPTY)
        found = tl.where(left & (held == key), slot, found)
        left = left & (held != key) & (held != EMPTY)
        slot = (slot + 1) & (blocks.slots - 1)
        probes += 1
    return found


@triton.jit
def enter(blocks, taken, key, live):
    """The slots of keys, entered where they are new, -1 where there was no place near; counts the new ones."""
    slot = home(blocks, key)
    found = tl.full(key.shape, -1, tl.int64)
    new = tl.zeros(key.shape, tl.int32)
    left = live
    probes = 0
    while some(left) & (probes < PROBES):
        held = tl.load(blocks.keys + slot, left, NEVER)
        free = left & (held == EMPTY)
        if some(free):
            # There is no mask: lanes without a free slot compare with what no slot holds.
            seen = tl.atomic_cas(blocks.keys + slot, tl.where(free, EMPTY, NEVER).to(tl.int64), key, sem="relaxed")
            made = free & (seen == EMPTY)
            new += made.to(tl.int32)
            held = tl.where(made, key, tl.where(free, seen, held))
        found = tl.where(left & (held == key), slot, found)
        left = left & (held != key)
        slot = (slot + 1) & (blocks.slots - 1)
        probes += 1
    count = tl.sum(new)
    if count > 0:
        tl.atomic_add(taken, count, sem="relaxed")
    return found


@triton.jit(do_not_specialize=["total"])
def enter_kernel(blocks, taken, keys, slots, total, block: tl.constexpr):
    """Enter keys [N]; their slots [N], -1 where there was no place."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < total
    tl.store(slots + i, enter(blocks, taken, tl.load(keys + i, live, 0), live), live)


@triton.jit
def cell_of(position, voxel):
    """The lattice point below a coordinate (float64 metres), int64, and the fraction from there on, float32."""
    at = position / voxel
    below = tl.floor(at)
    return below.to(tl.int64), (at - below).to(tl.float32)


@triton.jit
def trilinear(value, along, wx, wy, wz):
    """Value [P] and its derivatives by the fractions from those at eight corners [P, 8]. w: weight of each corner along
    an axis; along: 1 or -1, the derivatives of these weights."""
    return (
        tl.sum(wx * wy * wz * value, 1),
        tl.sum(along[0] * (wy * wz * value), 1),
        tl.sum(along[1] * (wx * wz * value), 1),
        tl.sum(along[2] * (wx * wy * value), 1),
    )


@triton.jit
def sample(blocks, world, live):
    """At world positions (x, y, z: float64 [P]): distance in truncations and luminance, each with its derivatives by
    the lattice coordinates, and whether all eight voxels around have been seen."""
    voxel = tl.load(blocks.lengths)
    ix, fx = cell_of(world[0], voxel)
    iy, fy = cell_of(world[1], voxel)
    iz, fz = cell_of(world[2], voxel)
    corner = tl.arange(0, 8)[None, :]
    a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
    kx, ky, kz = ix[:, None] + a, iy[:, None] + b, iz[:, None] + c
    slot = find(blocks, block_key(kx >> 3, ky >> 3, kz >> 3), live[:, None] & (corner >= 0))
    at = blocks.voxels + slot * (3 * CELLS) + 3 * ((kx & 7) | ((ky & 7) << 3) | ((kz & 7) << 6))
    known = tl.min(tl.load(at + 2, slot >= 0, 0).to(tl.int32), 1) > 0
    distance = tl.load(at, slot >= 0, 0).to(tl.float32) * (1 / SCALE)
    light = tl.load(at + 1, slot >= 0, 0).to(tl.float32) * (1 / SCALE)
    along = 2.0 * a - 1, 2.0 * b - 1, 2.0 * c - 1
    wx = tl.where(a == 1, fx[:, None], 1 - fx[:, None])
    wy = tl.where(b == 1, fy[:, None], 1 - fy[:, None])
    wz = tl.where(c == 1, fz[:, None], 1 - fz[:, None])
    return trilinear(distance, along, wx, wy, wz), trilinear(light, along, wx, wy, wz), known


@triton.jit(do_not_specialize=["total"])
def distances_kernel(blocks, points, c2w, distance, total, width: tl.constexpr, block: tl.constexpr):
    """Signed distance [N] in metres at points [N, width], seen from a pose c2w, NaN where it is unknown and, with a
    width of 4, where the third coordinate is 0."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < total
    local = triple(points + width * i, live)
    if width == 4:
        live = live & (local[2] > 0)
    found, _, known = sample(blocks, (moved(c2w, local, 0), moved(c2w, local, 1), moved(c2w, local, 2)), live)
    truncation = tl.load(blocks.lengths + 1).to(tl.float32)
    tl.store(distance + i, tl.where(known & live, found[0] * truncation, float("nan")), i < total)
