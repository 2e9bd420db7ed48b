"""Where the map is looked at: depths along rays, and the lattice of the smoothness term."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from .config import MappingConfig, SamplingConfig
from .field import TsdfField
from .kernels import Backend, RayBatch

LEAST_UNIFORM = 4  # fewer samples say too little about where the surface is


def ray_exit(origin: Tensor, direction: Tensor, box: Tensor, limit: float) -> Tensor:
    """Depth [R], at most ``limit``, at which rays (origin, world direction at unit depth: [R, 3]) leave the box."""
    safe = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction)
    last = torch.maximum((box[0] - origin) / safe, (box[1] - origin) / safe).amin(-1)
    return last.clamp(0.2, limit)


def thinned(z: Tensor, config: SamplingConfig) -> Tensor:
    """``uniform`` of the depths [R, S] of each ray, which the others are to follow."""
    keep = (torch.arange(config.uniform, device=z.device) * (z.shape[1] / config.uniform)).long()
    return z.index_select(1, keep)


def rendered_depths(rays: RayBatch, c2w: Tensor, field: TsdfField, kernels: Backend, jitter: Tensor) -> Tensor:
    """Depths [R, S + K] of rays without a measured one: their own [R, S], and as many as ``jitter`` [R, K] in 0..1 has
    where the map has its surface."""
    _, _, weights = kernels.render(field.layout, field.params, c2w, rays)
    return kernels.importance_depths(rays.z, weights, jitter)


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


def smooth_lattice(field: TsdfField, config: MappingConfig, generator: torch.Generator) -> Tensor:
    """Points [n^3, 3] of a lattice with n = ``smooth_points``, ``smooth_voxel_m`` apart, at random inside the box."""
    n = config.smooth_points
    low, high = field.layout.box
    extent = (n - 1) * config.smooth_voxel_m
    shift = torch.rand(3, generator=generator) * (high - low - extent).clamp_min(0)
    steps = torch.arange(n) * config.smooth_voxel_m
    lattice = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3) + low + shift
    return torch.minimum(torch.maximum(lattice, low), high).to(field.device)


def seeded(rng: np.random.Generator, device: torch.device) -> torch.Generator:
    """Random numbers on ``device`` that depend on the state of ``rng`` alone, which a checkpoint can hold anywhere."""
    return torch.Generator(device).manual_seed(int(rng.integers(2**62)))


def uniform(generator: torch.Generator, device: torch.device, *shape: int) -> Tensor:
    """Random numbers in 0..1 on ``device``, drawn where the generator is."""
    return torch.rand(*shape, generator=generator, device=generator.device).to(device)
