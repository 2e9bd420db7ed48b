"""The geometry of the multi-resolution grid: where levels lie in space and in the table, and how the box grows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..config import FieldConfig
from ..kernels.types import GridLayout


def build_layout(config: FieldConfig, box: NDArray[np.float64]) -> GridLayout:
    """The layout for a scene box [2, 3] in metres.

    Voxel sizes fall geometrically from (longest side / base_resolution) to ``finest_voxel_m``; cells are cubes. A level
    whose lattice fits the table is stored densely, the others are hashed (paper, equation 1; Mueller et al. 2022).
    """
    low, high = np.asarray(box, np.float64)
    coarsest = max(float((high - low).max()) / config.base_resolution, config.finest_voxel_m)
    ratio = (config.finest_voxel_m / coarsest) ** (1 / max(config.levels - 1, 1))
    voxel = torch.tensor([coarsest * ratio**level for level in range(config.levels)], dtype=torch.float32)
    anchor = torch.tensor(low, dtype=torch.float32)
    edges = torch.tensor(np.stack([low, high]), dtype=torch.float32)
    first, dims = _extent(voxel, anchor, edges)
    hashed = dims.prod(-1) > 2**config.log2_table_size
    dims = torch.where(hashed[:, None], 0, dims)
    size = torch.where(hashed, 2**config.log2_table_size, dims.prod(-1))
    return GridLayout(
        offset=torch.cumsum(size, 0) - size,
        size=size,
        voxel=voxel,
        first=first,
        dims=dims,
        anchor=anchor,
        blob_low=anchor.clone(),
        blob_size=edges[1] - edges[0],
        box=edges,
        bins=config.blob_bins,
    )


def _extent(voxel: Tensor, anchor: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """First lattice point and number of lattice points of every level that cover the box: int64 [L, 3] each."""
    cell = torch.floor((box[:, None].double() - anchor.double()) / voxel[:, None].double()).long()
    return cell[0], cell[1] - cell[0] + 2


def grow_layout(layout: GridLayout, box: NDArray[np.float64]) -> GridLayout:
    """The layout over the union of its box and ``box`` [2, 3]. Cells stay where they are and dense levels stay dense,
    so with ``regrow`` the field keeps its value at every point of the old box."""
    other = torch.tensor(np.asarray(box), dtype=torch.float32)
    union = torch.stack([torch.minimum(layout.box[0], other[0]), torch.maximum(layout.box[1], other[1])])
    first, dims = _extent(layout.voxel, layout.anchor, union)
    dense = (layout.dims[:, 0] > 0)[:, None]
    dims = torch.where(dense, dims, 0)
    size = torch.where(dense[:, 0], dims.prod(-1), layout.size)
    return replace(
        layout,
        offset=torch.cumsum(size, 0) - size,
        size=size,
        first=torch.where(dense, first, layout.first),
        dims=dims,
        box=union,
    )


def regrow(old: GridLayout, new: GridLayout, rows: Tensor, fill: Tensor | None = None) -> Tensor:
    """Carry per-row data [rows, C] of the old layout over to the new one; new rows come from ``fill`` (or are zero)."""
    total = int(new.size.sum())
    out = torch.zeros(total, rows.shape[1], dtype=rows.dtype, device=rows.device) if fill is None else fill.clone()
    for level in range(old.levels):
        a, n = int(old.offset[level]), int(old.size[level])
        b, m = int(new.offset[level]), int(new.size[level])
        if not int(old.dims[level, 0]):
            out[b : b + m] = rows[a : a + n]
            continue
        (ox, oy, oz), (nx, ny, nz) = old.dims[level].tolist(), new.dims[level].tolist()
        sx, sy, sz = (old.first[level] - new.first[level]).tolist()
        block = out[b : b + m].view(nz, ny, nx, -1)
        block[sz : sz + oz, sy : sy + oy, sx : sx + ox] = rows[a : a + n].view(oz, oy, ox, -1)
    return out


def table_rows(layout: GridLayout) -> int:
    """How many rows the table has."""
    return int(layout.size.sum())


def box_of_points(points: NDArray[np.floating], margin_m: float) -> NDArray[np.float64]:
    """Scene box [2, 3] around points [N, 3] with a margin; ignores the farthest 0.1 % on every side as outliers."""
    low, high = np.percentile(points.astype(np.float64), [0.1, 99.9], axis=0)
    side = math.sqrt(float(((high - low) ** 2).sum())) * 0.02
    return np.stack([low - margin_m - side, high + margin_m + side])
