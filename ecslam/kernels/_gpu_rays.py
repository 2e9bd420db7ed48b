"""Triton kernels over blocks of rays: volume rendering, the losses and the way back to TSDF, colour and beta."""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor


class Targets(NamedTuple):
    """What was measured along R rays of S samples each (see ``RayBatch``; feature as uint8)."""

    z: Tensor
    depth: Tensor
    color: Tensor
    feature: Tensor
    rays: int
    samples: int


@triton.jit
def composite(sdf, beta, there):
    """Along rays [B, S] (paper, equations 2 and 3): sigmoid(-beta sdf), its complement, density, what passes before a
    sample, and rendering weights."""
    sharp = tl.where(there, tl.sigmoid(-beta * sdf), 0.0)
    rest = tl.where(there, tl.sigmoid(beta * sdf), 0.0)
    sigma = beta * sharp
    before = tl.exp(sigma - tl.cumsum(sigma, 1))
    return sharp, rest, sigma, before, before * (1 - tl.exp(-sigma))


@triton.jit
def ray_block(targets, block: tl.constexpr, padded: tl.constexpr):
    """Rays of this program [block], which exist, the samples' places [block, padded] and which exist."""
    ray = tl.program_id(0) * block + tl.arange(0, block)
    live = ray < targets.rays
    step = tl.arange(0, padded)[None, :]
    return ray, live, ray[:, None] * targets.samples + step, live[:, None] & (step < targets.samples)


@triton.jit
def render_kernel(targets, sdf, rgb, beta, color, depth, weights, block: tl.constexpr, padded: tl.constexpr):
    """Colour [R, 3], depth [R] and weights [R, S] from TSDF and colour of the samples."""
    ray, live, at, there = ray_block(targets, block, padded)
    _, _, _, _, weight = composite(tl.load(sdf + at, there, 0.0), tl.load(beta), there)
    tl.store(weights + at, weight, there)
    tl.store(depth + ray, tl.sum(weight * tl.load(targets.z + at, there, 0.0), 1), live)
    for k in tl.static_range(3):
        tl.store(color + 3 * ray + k, tl.sum(weight * tl.load(rgb + 3 * at + k, there, 0.0), 1), live)


@triton.jit
def count_rays(targets):
    """One over how many rays have a depth, are uniform, are features, and the latter two with a depth (at least 1).

    Every program counts them all: a few kilobytes from the cache cost less than another launch.
    """
    uniform, feature = tl.full([1024], 0, tl.int32), tl.full([1024], 0, tl.int32)
    uniform_deep, feature_deep = tl.full([1024], 0, tl.int32), tl.full([1024], 0, tl.int32)
    for first in range(0, targets.rays, 1024):
        ray = first + tl.arange(0, 1024)
        live = ray < targets.rays
        chosen = tl.load(targets.feature + ray, live, 0) != 0
        deep = tl.load(targets.depth + ray, live, 0.0) > 0
        uniform += (live & (chosen == 0)).to(tl.int32)
        feature += (live & chosen).to(tl.int32)
        uniform_deep += (live & deep & (chosen == 0)).to(tl.int32)
        feature_deep += (live & deep & chosen).to(tl.int32)
    u, f, ud, fd = tl.sum(uniform), tl.sum(feature), tl.sum(uniform_deep), tl.sum(feature_deep)
    return share(ud + fd), share(u), share(f), share(ud), share(fd)


@triton.jit
def share(count):
    """1 / max(count, 1)."""
    return 1.0 / tl.maximum(count, 1).to(tl.float32)


@triton.jit
def sdf_term(error, slope, mask, weight):
    """A ray's mean over its masked samples of a squared error: the sum over the block, and the gradient by TSDF."""
    each = tl.where(mask, weight * share(tl.sum(mask.to(tl.int32), 1))[:, None], 0.0)
    return tl.sum(each * error * error), 2 * each * error * slope


@triton.jit
def losses_kernel(
    targets,
    sdf,
    rgb,
    beta_at,
    weights,
    losses,
    d_beta_at,
    want_beta: tl.constexpr,
    block: tl.constexpr,
    padded: tl.constexpr,
):
    """Add the five terms to ``losses`` and overwrite TSDF and colour by their gradients (colour before its sigmoid).

    weights: the fields of ``Weights`` in their order.
    """
    free, centre, tail, depth_uniform, depth_feature, colour_uniform, colour_feature, truncation, centre_share = weights
    of_deep, of_uniform, of_feature, of_uniform_deep, of_feature_deep = count_rays(targets)
    ray, live, at, there = ray_block(targets, block, padded)
    beta = tl.load(beta_at)
    s, z = tl.load(sdf + at, there, 0.0), tl.load(targets.z + at, there, 0.0)
    sharp, rest, sigma, before, weight = composite(s, beta, there)

    measured = tl.load(targets.depth + ray, live, 0.0)
    chosen = tl.load(targets.feature + ray, live, 0) != 0
    deep = live & (measured > 0)
    signed = z - measured[:, None]
    known = there & deep[:, None]
    front = known & (signed < -truncation)
    band = known & (tl.abs(signed) <= truncation)
    middle = band & (tl.abs(signed) < centre_share * truncation)
    loss_free, d_free = sdf_term(s - 1, 1.0, front, free * of_deep)
    surface = signed + s * truncation
    loss_centre, d_centre = sdf_term(surface, truncation, middle, centre * of_deep)
    loss_tail, d_tail = sdf_term(surface, truncation, band & (middle == 0), tail * of_deep)

    depth_error = tl.where(deep, tl.sum(weight * z, 1) - measured, 0.0)
    depth_weight = tl.where(chosen, depth_feature * of_feature_deep, depth_uniform * of_uniform_deep)
    loss_depth = tl.sum(depth_weight * depth_error * depth_error)
    pull = (2 * depth_weight * depth_error)[:, None] * z
    colour_weight = tl.where(live, tl.where(chosen, colour_feature * of_feature, colour_uniform * of_uniform), 0.0) / 3
    loss_colour = 0.0
    for k in tl.static_range(3):
        shade = tl.load(rgb + 3 * at + k, there, 0.0)
        error = tl.sum(weight * shade, 1) - tl.load(targets.color + 3 * ray + k, live, 0.0)
        loss_colour += tl.sum(colour_weight * error * error)
        up = (2 * colour_weight * error)[:, None]
        pull += up * shade
        tl.store(rgb + 3 * at + k, up * weight * shade * (1 - shade), there)

    # What all samples are pulled by alike only scales what the ray lets through: apart, nothing large cancels.
    common = tl.sum(weight * pull, 1) / tl.maximum(tl.sum(weight, 1), 1e-12)
    pull -= common[:, None]
    behind = pull * weight
    d_sigma = pull * before * tl.exp(-sigma) - (tl.cumsum(behind, 1, reverse=True) - behind)
    d_sigma += (common * tl.exp(-tl.sum(sigma, 1)))[:, None]
    d_sdf = d_free + d_centre + d_tail - d_sigma * beta * beta * sharp * rest
    tl.store(sdf + at, d_sdf, there)
    if want_beta:
        d_beta = d_sigma * sharp * (1 - beta * s * rest)
        tl.atomic_add(d_beta_at, tl.sum(tl.where(there, d_beta, 0.0)), sem="relaxed")
    tl.atomic_add(losses, loss_free, sem="relaxed")
    tl.atomic_add(losses + 1, loss_centre, sem="relaxed")
    tl.atomic_add(losses + 2, loss_tail, sem="relaxed")
    tl.atomic_add(losses + 3, loss_depth, sem="relaxed")
    tl.atomic_add(losses + 4, loss_colour, sem="relaxed")
