"""The smoothness term; the per-ray losses live with the kernels (``kernels.reference.losses``)."""

from __future__ import annotations

import torch
from torch import Tensor

from .config import MappingConfig
from .field import TsdfField
from .kernels.reference import CORNERS, row


def smooth_lattice(field: TsdfField, config: MappingConfig, generator: torch.Generator) -> Tensor:
    """Points [n^3, 3] of a lattice with n = ``smooth_points``, ``smooth_voxel_m`` apart, at random inside the box."""
    n = config.smooth_points
    low, high = field.layout.box
    extent = (n - 1) * config.smooth_voxel_m
    shift = torch.rand(3, generator=generator) * (high - low - extent).clamp_min(0)
    steps = torch.arange(n) * config.smooth_voxel_m
    lattice = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3) + low + shift
    return torch.minimum(torch.maximum(lattice, low), high).to(field.device)


def smoothness_gradient(field: TsdfField, lattice: Tensor) -> Tensor:
    """Gradient [rows, 2] by the table of the mean squared difference of hash features between lattice neighbours
    (Co-SLAM, equation 9). Written level by level without autograd, whose graph would take gigabytes."""
    layout, table = field.layout, field.params.table
    n = round(len(lattice) ** (1 / 3))
    corners = torch.tensor(CORNERS, device=table.device)
    gradient = torch.zeros_like(table)
    for level in range(layout.levels):
        p = (lattice - layout.anchor.to(lattice)) / layout.voxel[level].to(lattice)
        cell = p.floor()
        f = (p - cell)[:, None]
        weight = torch.where(corners.bool(), f, 1 - f).prod(-1)  # [n^3, 8]
        rows = row(layout, level, cell.long()[:, None] + corners)
        feature = (weight[..., None] * table[rows]).sum(1).reshape(n, n, n, -1)
        d_feature = torch.zeros_like(feature)
        for axis in range(3):
            d = torch.diff(feature, dim=axis)
            d_feature.narrow(axis, 1, n - 1).add_(d, alpha=2 / n**3)
            d_feature.narrow(axis, 0, n - 1).sub_(d, alpha=2 / n**3)
        spread = weight[..., None] * d_feature.reshape(-1, 1, feature.shape[-1])
        gradient.index_add_(0, rows.reshape(-1), spread.reshape(-1, feature.shape[-1]))
    return gradient
