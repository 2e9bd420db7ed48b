"""The smoothness term; the per-ray losses live with the kernels (``kernels.reference.losses``)."""

from __future__ import annotations

import torch
from torch import Tensor

from .config import MappingConfig
from .field import TsdfField
from .kernels.reference import encode_hash


def smoothness(field: TsdfField, table: Tensor, config: MappingConfig, generator: torch.Generator) -> Tensor:
    """Mean squared difference of hash features between neighbours of a random lattice (Co-SLAM, equation 9).

    ``smooth_points``^3 lattice points, ``smooth_voxel_m`` apart, placed at random inside the scene box.
    """
    n = config.smooth_points
    low, high = field.layout.box.to(table)
    extent = (n - 1) * config.smooth_voxel_m
    shift = torch.rand(3, generator=generator).to(table) * (high - low - extent).clamp_min(0)
    steps = torch.arange(n, device=table.device) * config.smooth_voxel_m
    lattice = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1) + low + shift
    inside = torch.minimum(torch.maximum(lattice.reshape(-1, 3), low), high)
    features = encode_hash(field.layout, table, inside).reshape(n, n, n, -1)
    return sum(torch.diff(features, dim=axis).square().sum() for axis in range(3)) / n**3  # type: ignore[return-value]


def smoothness_gradient(field: TsdfField, config: MappingConfig, generator: torch.Generator) -> Tensor:
    """Gradient of the weighted smoothness term with respect to the table."""
    with torch.enable_grad():
        table = field.params.table.detach().requires_grad_()
        value = config.smooth_weight * smoothness(field, table, config, generator)
        return torch.autograd.grad(value, table)[0]
