"""Where the smoothness term is taken; the losses and their gradients live with the kernels (``kernels.reference``)."""

from __future__ import annotations

import torch
from torch import Tensor

from .config import MappingConfig
from .field import TsdfField


def smooth_lattice(field: TsdfField, config: MappingConfig, generator: torch.Generator) -> Tensor:
    """Points [n^3, 3] of a lattice with n = ``smooth_points``, ``smooth_voxel_m`` apart, at random inside the box."""
    n = config.smooth_points
    low, high = field.layout.box
    extent = (n - 1) * config.smooth_voxel_m
    shift = torch.rand(3, generator=generator) * (high - low - extent).clamp_min(0)
    steps = torch.arange(n) * config.smooth_voxel_m
    lattice = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3) + low + shift
    return torch.minimum(torch.maximum(lattice, low), high).to(field.device)
