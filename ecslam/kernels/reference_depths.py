"""Depths along rays, readable, on any device: uniform to the surface, dense around it, or where the map puts it."""

from __future__ import annotations

import torch
from torch import Tensor


def stratified(near: Tensor, far: Tensor, count: int, jitter: Tensor) -> Tensor:
    """``count`` depths per ray [R, count] in [near, far], one per equal interval; ``jitter`` [R, count] in 0..1."""
    share = (torch.arange(count, device=near.device) + jitter) / max(count, 1)
    return near[:, None] + (far - near)[:, None] * share


def sample_depths(depth: Tensor, far: Tensor, jitter: Tensor, uniform: int, near_m: float, reach_m: float) -> Tensor:
    """Sorted depths [R, S] (paper, section III-A: N = N_u + N_d), with N_u = ``uniform``. jitter: [R, S] in 0..1.

    With a measured depth d, N_u samples run from ``near_m`` to d + ``reach_m`` and N_d lie within ``reach_m`` of d.
    Rays without one (depth 0) get all their samples uniformly out to ``far`` [R].
    """
    has = depth > 0
    near = torch.full_like(depth, near_m)
    end = torch.where(has, depth + reach_m, far)
    start = torch.where(has, (depth - reach_m).clamp_min(near_m), near)
    along = stratified(near, end, uniform, jitter[:, :uniform])
    around = stratified(start, end, jitter.shape[1] - uniform, jitter[:, uniform:])
    return torch.cat([along, around], 1).sort(1).values


def drawn(z: Tensor, weights: Tensor, jitter: Tensor) -> Tensor:
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


def importance_depths(z: Tensor, weights: Tensor, jitter: Tensor) -> Tensor:
    """Depths [R, S + K], ascending: z [R, S], which ascend (S at least 3), and K ``drawn`` from their weights."""
    return torch.cat([z, drawn(z, weights, jitter)], 1).sort(1).values
