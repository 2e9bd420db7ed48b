"""Triton kernel over blocks of rays: depths drawn from what was rendered."""

from __future__ import annotations

import triton
import triton.language as tl

LEAST_DENSITY, LEAST_STEP = tl.constexpr(1e-5), tl.constexpr(1e-8)


@triton.jit
def at_index(values, step, index):
    """The value of each row [B, S] at its ``index`` [B]."""
    return tl.sum(tl.where(step == index[:, None], values, 0.0), 1)


@triton.jit(do_not_specialize=["rays"])
def importance_kernel(z, weights, jitter, out, rays, samples, count, block: tl.constexpr, padded: tl.constexpr):
    """Ascending depths ``out`` [R, S + K]: z [R, S] and K drawn from their rendering weights by ``jitter`` [R, K].

    Both ascend, so each finds its place by counting how many of the others lie below. padded: a power of two, S or
    more.
    """
    ray, step = tl.program_id(0) * block + tl.arange(0, block), tl.arange(0, padded)[None, :]
    there = ray < rays
    live, at = there[:, None] & (step < samples), ray[:, None] * samples + step
    first = tl.load(z + at, live, 0.0)
    inner = live & (step > 0) & (step < samples - 1)
    density = tl.where(inner, tl.load(weights + at, inner, 0.0) + LEAST_DENSITY, 0.0)
    passed = tl.cumsum(density, 1) / tl.maximum(tl.sum(density, 1), LEAST_DENSITY)[:, None]
    middle = 0.5 * (first + tl.load(z + at + 1, live & (step < samples - 1), 0.0))

    own = tl.where(live, first, float("inf"))
    to, below = out + ray * (samples + count), tl.zeros([block, padded], tl.int32)
    last = tl.full([block], 0.0, tl.float32)
    for k in range(count):
        u = (k + tl.load(jitter + ray * count + k, there, 0.0)) / count
        right = tl.sum(((passed <= u[:, None]) & (step < samples - 1)).to(tl.int32), 1)
        right = tl.minimum(tl.maximum(right, 1), samples - 2)
        before, behind = at_index(passed, step, right - 1), at_index(passed, step, right)
        near, far = at_index(middle, step, right - 1), at_index(middle, step, right)
        last = tl.maximum(last, near + (u - before) / tl.maximum(behind - before, LEAST_STEP) * (far - near))
        tl.store(to + k + tl.sum((own <= last[:, None]).to(tl.int32), 1), last, there)
        below += (last[:, None] < own).to(tl.int32)
    tl.store(to[:, None] + step + below, own, live)
