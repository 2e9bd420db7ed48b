"""Which depths along a ray: uniform to the surface, dense around the measured depth, or where the map puts it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from .config import SamplingConfig
from .field import TsdfField
from .kernels import Backend, RayBatch, depths_cpu

LEAST_UNIFORM = 4  # fewer samples say too little about where the surface is


def ray_exit(origin: Tensor, direction: Tensor, box: Tensor, limit: float) -> Tensor:
    """Depth [R], at most ``limit``, at which rays (origin, world direction at unit depth: [R, 3]) leave the box."""
    safe = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction)
    last = torch.maximum((box[0] - origin) / safe, (box[1] - origin) / safe).amin(-1)
    return last.clamp(0.2, limit)


def stratified(near: Tensor, far: Tensor, count: int, jitter: Tensor) -> Tensor:
    """``count`` depths per ray [R, count] in [near, far], one per equal interval; ``jitter`` [R, count] in 0..1."""
    share = (torch.arange(count, device=near.device) + jitter) / max(count, 1)
    return near[:, None] + (far - near)[:, None] * share


def sample_depths(depth: Tensor, far: Tensor, config: SamplingConfig, jitter: Tensor) -> Tensor:
    """Sorted depths [R, uniform + near_depth] (paper, section III-A: N = N_u + N_d).

    With a measured depth d, N_u samples run from the camera to d + d_t and N_d lie within [d - d_t, d + d_t]. Rays
    without one (depth 0) get all their samples uniformly out to ``far`` [R]; see ``importance_depths``. jitter:
    [R, uniform + near_depth] in 0..1.
    """
    if depth.device.type == "cpu":
        return depths_cpu.sample(depth, far, jitter, config.uniform, config.near_m, config.depth_range_m)
    return sample_plain(depth, far, config, jitter)


def sample_plain(depth: Tensor, far: Tensor, config: SamplingConfig, jitter: Tensor) -> Tensor:
    """``sample_depths``, readable, on any device."""
    n_u, n_d, reach = config.uniform, config.near_depth, config.depth_range_m
    has = depth > 0
    near = torch.full_like(depth, config.near_m)
    end = torch.where(has, depth + reach, far)
    start = torch.where(has, (depth - reach).clamp_min(config.near_m), near)
    along = stratified(near, end, n_u, jitter[:, :n_u])
    around = stratified(start, end, n_d, jitter[:, n_u:])
    return torch.cat([along, around], 1).sort(1).values


def importance_depths(z: Tensor, weights: Tensor, jitter: Tensor) -> Tensor:
    """Depths [R, K] drawn from rendered weights [R, S] at depths z [R, S] (inverse transform). jitter: [R, K], 0..1."""
    middle = 0.5 * (z[:, 1:] + z[:, :-1])
    density = weights[:, 1:-1] + 1e-5
    cdf = torch.cumsum(density / density.sum(1, keepdim=True), 1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf], 1)
    u = stratified(torch.zeros_like(z[:, 0]), torch.ones_like(z[:, 0]), jitter.shape[1], jitter)
    right = torch.searchsorted(cdf, u, right=True).clamp(1, cdf.shape[1] - 1)
    c0, c1 = cdf.gather(1, right - 1), cdf.gather(1, right)
    z0, z1 = middle.gather(1, right - 1), middle.gather(1, right)
    return z0 + (u - c0) / (c1 - c0).clamp_min(1e-8) * (z1 - z0)


def follow(z: Tensor, weights: Tensor, jitter: Tensor) -> Tensor:
    """Depths [R, S + K], ascending: z [R, S], which ascend, and ``importance_depths`` drawn from their weights."""
    fused = depths_cpu.follow if z.device.type == "cpu" else _follow_on_gpu() if z.is_cuda else follow_plain
    return fused(z, weights, jitter)


@cache
def _follow_on_gpu() -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """``follow`` in one launch, if Triton can run."""
    try:
        from .kernels.depths_gpu import follow as fused
    except ImportError:
        return follow_plain
    return fused


def follow_plain(z: Tensor, weights: Tensor, jitter: Tensor) -> Tensor:
    """``follow``, readable, on any device."""
    return torch.cat([z, importance_depths(z, weights, jitter)], 1).sort(1).values


def thinned(z: Tensor, config: SamplingConfig) -> Tensor:
    """``uniform`` of the depths [R, S] of each ray, which the others are to follow."""
    keep = (torch.arange(config.uniform, device=z.device) * (z.shape[1] / config.uniform)).long()
    return z.index_select(1, keep)


def rendered_depths(rays: RayBatch, c2w: Tensor, field: TsdfField, kernels: Backend, jitter: Tensor) -> Tensor:
    """Depths [R, S + K] of rays without a measured one: their own [R, S], and as many as ``jitter`` [R, K] in 0..1 has
    where the map has its surface."""
    _, _, weights = kernels.render(field.layout, field.params, c2w, rays)
    return follow(rays.z, weights, jitter)


def resampled(
    rays: RayBatch, c2w: Tensor, field: TsdfField, kernels: Backend, config: SamplingConfig, generator: torch.Generator
) -> Tensor:
    """Depths [R, S] for rays of which none has a measured one: some of their own, the rest ``rendered_depths``."""
    if config.uniform < LEAST_UNIFORM:
        return rays.z
    jitter = uniform(generator, rays.z.device, len(rays.z), rays.z.shape[1] - config.uniform)
    return rendered_depths(replace(rays, z=thinned(rays.z, config)), c2w, field, kernels, jitter)


def resample_missing(
    rays: RayBatch, c2w: Tensor, field: TsdfField, kernels: Backend, config: SamplingConfig, generator: torch.Generator
) -> None:
    """Those of the rays that have no depth are ``resampled``, in place. Waits for the device."""
    missing = torch.nonzero(rays.depth <= 0)[:, 0]
    rays.z.index_copy_(0, missing, resampled(rays.take(missing), c2w, field, kernels, config, generator))


def seeded(rng: np.random.Generator, device: torch.device) -> torch.Generator:
    """Random numbers on ``device`` that depend on the state of ``rng`` alone, which a checkpoint can hold anywhere."""
    return torch.Generator(device).manual_seed(int(rng.integers(2**62)))


def uniform(generator: torch.Generator, device: torch.device, *shape: int) -> Tensor:
    """Random numbers in 0..1 on ``device``, drawn where the generator is."""
    return torch.rand(*shape, generator=generator, device=generator.device).to(device)
