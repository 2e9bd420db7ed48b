"""The way back through the grid features as Triton code: from their gradients to the table and to the poses."""

from __future__ import annotations

import triton
import triton.language as tl

from ._gpu_field import PRIME_Y, PRIME_Z, locate, row_of
from ._gpu_points import level_places, load_placed, sample


@triton.jit
def add_corners(into, rows, shares, there):
    """Add the shares [N, 2] of four corners in both features to their rows [N] of the table's gradient."""
    feature = tl.arange(0, 2)[None, :]
    for c in tl.static_range(4):
        at = into + 2 * rows[c][:, None] + feature
        tl.atomic_add(at, shares[c], there[:, None] & (feature >= 0), sem="relaxed")


@triton.jit
def corner_shares(field, placed, total, d_features_at, i, level, further, shape: tl.constexpr):
    """What points i at levels give (all [N]) to the four corners at their near or ``further`` end along x: the corners'
    rows [N], their shares in the gradients of both features [N, 2], and which exist."""
    live = i < total
    there = live & (level < shape.levels)
    at = d_features_at + level * total + i
    d_even, d_odd = tl.load(at, there, 0.0), tl.load(at + shape.levels * total, there, 0.0)
    x, rest = load_placed(placed, 0, i, live, total), load_placed(placed, 1, i, live, total)
    fx, at_x = locate(field, x[0], rest[0], level, 0, 1, shape)
    fy, at_y = locate(field, x[1], rest[1], level, 1, PRIME_Y, shape)
    fz, at_z = locate(field, x[2], rest[2], level, 2, PRIME_Z, shape)
    mine, share = tl.where(further, at_x[1], at_x[0]), tl.where(further, fx, 1 - fx)
    both = tl.join(share * d_even, share * d_odd)
    rows = (
        row_of(field, mine, at_y[0], at_z[0], level, shape),
        row_of(field, mine, at_y[1], at_z[0], level, shape),
        row_of(field, mine, at_y[0], at_z[1], level, shape),
        row_of(field, mine, at_y[1], at_z[1], level, shape),
    )
    shares = (
        ((1 - fy) * (1 - fz))[:, None] * both,
        (fy * (1 - fz))[:, None] * both,
        ((1 - fy) * fz)[:, None] * both,
        (fy * fz)[:, None] * both,
    )
    return rows, shares, there


@triton.jit
def to_table(
    field, placed, total, d_features_at, into, program, run: tl.constexpr, lanes: tl.constexpr, shape: tl.constexpr
):
    """From the gradients of the grid features to the table.

    The atomics take the time, and a cache takes those that meet in the same 32 bytes at once. So neighbouring lanes add
    to neighbouring corners along x, of points that are neighbours on a ray; and a lane takes ``run`` such points one by
    one and adds once for all in a row that share a cell. A tile [width lanes] is flat, so that its order is certain.
    """
    number = tl.arange(0, shape.width * lanes)
    level, lane = number // lanes, number % lanes
    further = lane % 2 == 1
    i = (program * (lanes // 2) + lane // 2) * run
    rows, sums, there = corner_shares(field, placed, total, d_features_at, i, level, further, shape)
    for step in tl.static_range(1, run):
        new_rows, new, new_there = corner_shares(
            field, placed, total, d_features_at, i + step, level, further, shape,
        )  # fmt: skip
        same = (rows[0] == new_rows[0]) & (rows[1] == new_rows[1]) & (rows[2] == new_rows[2]) & (rows[3] == new_rows[3])
        same = same & new_there
        add_corners(into, rows, sums, there & (same == 0))
        more = same[:, None]
        sums = (
            new[0] + tl.where(more, sums[0], 0.0),
            new[1] + tl.where(more, sums[1], 0.0),
            new[2] + tl.where(more, sums[2], 0.0),
            new[3] + tl.where(more, sums[3], 0.0),
        )
        rows, there = new_rows, new_there
    add_corners(into, rows, sums, there)


@triton.jit
def add_poses(d_c2w, live, local, pose, gradient):
    """Add a block's share to the gradients [P, 3, 4] of its poses. Poses ascend, so a block meets few of them."""
    first, last = tl.min(tl.where(live, pose, 2147483647)), tl.max(tl.where(live, pose, -1))
    axis = tl.arange(0, 4)[None, :]
    gx, gy, gz = gradient[0][:, None], gradient[1][:, None], gradient[2][:, None]
    up = tl.where(axis == 0, gx, tl.where(axis == 1, gy, tl.where(axis == 2, gz, 0.0)))
    x, y, z = local[0].to(tl.float32)[:, None], local[1].to(tl.float32)[:, None], local[2].to(tl.float32)[:, None]
    lever = tl.where(axis == 0, x, tl.where(axis == 1, y, tl.where(axis == 2, z, 1.0)))
    entries = up[:, :, None] * lever[:, None, :]
    row, column = tl.arange(0, 4)[:, None], tl.arange(0, 4)[None, :]
    for p in range(first, last + 1):
        mine = (live & (pose == p))[:, None, None]
        total = tl.sum(tl.where(mine, entries, 0.0), 0)
        tl.atomic_add(d_c2w + 12 * p + 4 * row + column, total, (row < 3) & (column >= 0), sem="relaxed")


@triton.jit
def slid(field, slopes_at, i, live, total, d_even, d_odd, axis: tl.constexpr, shape: tl.constexpr):
    """Gradient by one world coordinate through the grid features, per metre [P], from theirs [P, width]."""
    level, further = tl.arange(0, shape.width), shape.levels * total
    where, there = level_places(i, live, total, shape)
    inverse = tl.load(field.inverse + 2 * level, level < shape.levels, 0.0)[None, :]
    even = tl.load(slopes_at + axis * further + where, there, 0.0)
    odd = tl.load(slopes_at + (3 + axis) * further + where, there, 0.0)
    return tl.sum((d_even * even + d_odd * odd) * inverse, 1)


@triton.jit
def to_poses(
    field, points, placed, total, d_features_at, slopes_at, d_world, d_c2w, program, shape: tl.constexpr,
    block: tl.constexpr,
):  # fmt: skip
    """From the gradients of the grid features, with their derivatives [2, 3, L, N] and the one-blob part of the
    position's gradient d_world [N, 3], to the poses."""
    i = program * block + tl.arange(0, block)
    live = i < total
    where, there = level_places(i, live, total, shape)
    d_even = tl.load(d_features_at + where, there, 0.0)
    d_odd = tl.load(d_features_at + shape.levels * total + where, there, 0.0)
    inside = load_placed(placed, 3, i, live, total)
    gx = slid(field, slopes_at, i, live, total, d_even, d_odd, 0, shape)
    gy = slid(field, slopes_at, i, live, total, d_even, d_odd, 1, shape)
    gz = slid(field, slopes_at, i, live, total, d_even, d_odd, 2, shape)
    gradient = (
        (gx + tl.load(d_world + 3 * i, live, 0.0)) * inside[0],
        (gy + tl.load(d_world + 3 * i + 1, live, 0.0)) * inside[1],
        (gz + tl.load(d_world + 3 * i + 2, live, 0.0)) * inside[2],
    )
    local, pose = sample(points, i, live)
    add_poses(d_c2w, live, local, pose, gradient)


@triton.jit(do_not_specialize=["total", "of_table"])
def grid_kernel(
    field, points, placed, total, of_table, d_features_at, slopes_at, d_world, into, d_c2w, want_params: tl.constexpr,
    want_poses: tl.constexpr, run: tl.constexpr, lanes: tl.constexpr, shape: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """From the gradients of the grid features [2, L, N] to the table, by so many programs ``of_table``, and to the
    poses, by those that follow: these wait for memory while those wait for atomics."""
    program = tl.program_id(0)
    if want_params and program < of_table:
        to_table(field, placed, total, d_features_at, into.table, program, run, lanes, shape)
    if want_poses and program >= of_table:
        program -= of_table
        to_poses(field, points, placed, total, d_features_at, slopes_at, d_world, d_c2w, program, shape, block)
