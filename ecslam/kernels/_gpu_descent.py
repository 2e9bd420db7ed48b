"""Triton kernels that align points to the fused volume: the sums and the steps, see ``descent``.

An alignment is a chain of rows ``state`` float64 [ROW], each written by one step from the row before and the sums at
its trial pose, so that nothing is changed in place and nothing waits for the host.
"""

from __future__ import annotations

import triton
import triton.language as tl

from ._gpu_align import add_points
from ._gpu_blocks import sample
from ._gpu_points import moved, triple

POSE, TRIAL = tl.constexpr(0), tl.constexpr(16)  # c2w [3, 4], the best one and the one to try
COUNT, COST, DAMPING, SIZE, DONE = (tl.constexpr(32 + k) for k in range(5))
EQUATIONS = tl.constexpr(48)  # [8, 8] at the best pose
ROW = 112
WIDTH = tl.constexpr(ROW)


@triton.jit
def sums_kernel(
    blocks, points, count, pose, done, settings, sums, stride, colour: tl.constexpr, block: tl.constexpr
):  # fmt: skip
    """Add to ``sums`` (see ``_gpu_align``) those of every ``stride``-th of ``count`` points float32 [N, 4], camera
    coordinates and luminance, at a pose [3, 4]; nothing once ``done`` is set."""
    first = stride * block * tl.program_id(0)
    i = first + stride * tl.arange(0, block)
    total = tl.load(count).to(tl.int32)
    if (first < total) & (tl.load(done) == 0):
        live = i < total
        local = triple(points + 4 * i, live)
        world = (moved(pose, local, 0), moved(pose, local, 1), moved(pose, local, 2))
        lever = (world[0] - tl.load(pose + 3), world[1] - tl.load(pose + 7), world[2] - tl.load(pose + 11))
        found, seen, known = sample(blocks, world, live)
        distance, gx, gy, gz = found
        light, lx, ly, lz = seen
        per_metre = 1 / tl.load(blocks.lengths).to(tl.float32)
        gradient = gx * per_metre, gy * per_metre, gz * per_metre
        d_light = lx * per_metre, ly * per_metre, lz * per_metre
        wanted = tl.load(points + 4 * i + 3, live, 0.0)
        add_points(sums, distance, gradient, light, d_light, wanted, lever, settings, known, colour)


@triton.jit
def solved(equations, damping):
    """The least-squares solution [8] (six numbers count) of a damped system [8, 8] whose column 6 is the right side, by
    Gauss-Jordan; the matrix is positive, so no pivot is sought."""
    row, column = tl.arange(0, 8)[:, None], tl.arange(0, 8)[None, :]
    a = tl.where((row == column) & (row < 6), equations + damping * (equations + 1e-9), equations)
    for k in tl.static_range(6):
        pivots, factors = tl.sum(tl.where(row == k, a, 0.0), 0), tl.sum(tl.where(column == k, a, 0.0), 1)
        scaled = pivots / tl.sum(tl.where(tl.arange(0, 8) == k, pivots, 0.0))
        a = tl.where(row == k, scaled[None, :], a - factors[:, None] * scaled[None, :])
    return tl.sum(tl.where(column == 6, a, 0.0), 1)


@triton.jit
def entry(vector, k: tl.constexpr):
    """One number of a vector [8]."""
    return tl.sum(tl.where(tl.arange(0, 8) == k, vector, 0.0))


@triton.jit
def store_retracted(into, pose, move):
    """``se3.retract`` of a pose [3, 4] by ``move`` [8]."""
    i = tl.arange(0, 4)
    p0, p1, p2 = tl.load(pose + i), tl.load(pose + 4 + i), tl.load(pose + 8 + i)
    w0, w1, w2 = entry(move, 3), entry(move, 4), entry(move, 5)
    angle = tl.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    scale = 1 / tl.maximum(angle, 1e-200)
    w0, w1, w2 = w0 * scale, w1 * scale, w2 * scale
    c, s = tl.cos(angle), tl.sin(angle)
    along = (1 - c) * (w0 * p0 + w1 * p1 + w2 * p2)
    q0 = c * p0 + s * (w1 * p2 - w2 * p1) + w0 * along
    q1 = c * p1 + s * (w2 * p0 - w0 * p2) + w1 * along
    q2 = c * p2 + s * (w0 * p1 - w1 * p0) + w2 * along
    tl.store(into + i, tl.where(i == 3, p0 + entry(move, 0), q0))
    tl.store(into + 4 + i, tl.where(i == 3, p1 + entry(move, 1), q1))
    tl.store(into + 8 + i, tl.where(i == 3, p2 + entry(move, 2), q2))


@triton.jit
def take(before, sums, after, settings, stride, rules: tl.constexpr, first: tl.constexpr):
    """See ``step_kernel``."""
    _, kernel, _, _, _, scale, colour_kernel = settings
    row, column = tl.arange(0, 8)[:, None], tl.arange(0, 8)[None, :]
    equations = tl.load(sums + 8 * row + column)
    used, count = tl.load(sums + 65), tl.load(before + COUNT)
    worst = kernel * kernel + scale * colour_kernel * (scale * colour_kernel)
    cost = tl.load(sums + 64) + 0.5 * worst * (tl.ceil(count / stride) - used)
    pose, damping = before + POSE, tl.full([], rules.damping, tl.float64)
    done = used < rules.least_used
    if not first:
        held = tl.load(before + COST)
        size, damping = tl.load(before + SIZE), tl.load(before + DAMPING)
        gain = cost < held
        damping = tl.where(gain, tl.maximum(damping / 3, rules.least_damping), damping * 10)
        settled = (held - cost < rules.settled * held) | (size < rules.still_after_gain)
        hopeless = (damping > rules.most_damping) | (size < rules.still_after_loss)
        done = tl.where(gain, done | settled, hopeless)
        pose = before + tl.where(gain, TRIAL, POSE)
        cost = tl.where(gain, cost, held)
        equations = tl.where(gain, equations, tl.load(before + EQUATIONS + 8 * row + column))
    move = -solved(equations, damping)
    i = tl.arange(0, 16)
    tl.store(after + POSE + i, tl.load(pose + i, i < 12, 0.0), i < 12)
    store_retracted(after + TRIAL, pose, move)
    tl.store(after + COUNT, count)
    tl.store(after + COST, cost)
    tl.store(after + DAMPING, damping)
    tl.store(after + SIZE, tl.max(tl.where(tl.arange(0, 8) < 6, tl.abs(move), 0.0)))
    tl.store(after + DONE, done.to(tl.float64))
    tl.store(after + EQUATIONS + 8 * row + column, equations)


@triton.jit
def step_kernel(before, sums, after, settings, stride, rules: tl.constexpr, first: tl.constexpr):
    """Write the row ``after`` from ``before`` and the sums at its trial pose: take that pose or leave it, then try the
    next; a stage that has ended stays as it is. first: the sums are those at the best pose itself, and a stage
    begins."""
    if first:
        take(before, sums, after, settings, stride, rules, True)
    elif tl.load(before + DONE) > 0:
        i = tl.arange(0, 128)
        tl.store(after + i, tl.load(before + i, i < WIDTH, 0.0), i < WIDTH)
    else:
        take(before, sums, after, settings, stride, rules, False)
