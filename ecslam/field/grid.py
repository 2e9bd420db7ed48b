"""The geometry of the multi-resolution grid: where levels lie in space and in the table, and how the box grows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..config import FieldConfig
from ..kernels.reference import row
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
    first, dims, size = _extent(voxel, anchor, edges, 2**config.log2_table_size)
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


def _extent(voxel: Tensor, anchor: Tensor, box: Tensor, table_size: int) -> tuple[Tensor, Tensor, Tensor]:
    """``first``, ``dims`` and ``size`` of the levels over a box [2, 3]; those that exceed the table are hashed."""
    cell = torch.floor((box[:, None].double() - anchor.double()) / voxel[:, None].double()).long()
    dims = cell[1] - cell[0] + 2
    hashed = dims.prod(-1) > table_size
    return cell[0], torch.where(hashed[:, None], 0, dims), torch.where(hashed, table_size, dims.prod(-1))


def grow_layout(layout: GridLayout, box: NDArray[np.float64], table_size: int) -> GridLayout:
    """The layout over the union of its box and ``box`` [2, 3]. Cells stay where they are, so with ``regrow`` a level
    keeps its value at every point of the old box, but for the collisions of one that is hashed from now on because its
    lattice exceeds ``table_size``."""
    other = torch.tensor(np.asarray(box), dtype=torch.float32)
    union = torch.stack([torch.minimum(layout.box[0], other[0]), torch.maximum(layout.box[1], other[1])])
    first, dims, size = _extent(layout.voxel, layout.anchor, union, table_size)
    return replace(layout, offset=torch.cumsum(size, 0) - size, size=size, first=first, dims=dims, box=union)


def regrow(old: GridLayout, new: GridLayout, rows: Tensor) -> Tensor:
    """Carry per-row data [rows, C] of the old layout over to the new one; the other rows are zero.

    Of lattice points that share a row from now on the one with the longest data keeps it: what nothing has trained is
    next to zero.
    """
    out = torch.zeros(table_rows(new), rows.shape[1], dtype=rows.dtype, device=rows.device)
    for level in range(old.levels):
        a, n = int(old.offset[level]), int(old.size[level])
        b, m = int(new.offset[level]), int(new.size[level])
        if not int(old.dims[level, 0]):
            out[b : b + m] = rows[a : a + n]
            continue
        if not int(new.dims[level, 0]):
            out[b : b + m] = _hashed(rows[a : a + n], row(new, level, _lattice(old, level)) - b, m)
            continue
        (ox, oy, oz), (nx, ny, nz) = old.dims[level].tolist(), new.dims[level].tolist()
        sx, sy, sz = (old.first[level] - new.first[level]).tolist()
        block = out[b : b + m].view(nz, ny, nx, -1)
        block[sz : sz + oz, sy : sy + oy, sx : sx + ox] = rows[a : a + n].view(oz, oy, ox, -1)
    return out


def _lattice(layout: GridLayout, level: int) -> Tensor:
    """The lattice points int64 [rows, 3] of a dense level, in the order of its rows."""
    axes = [torch.arange(n) + f for n, f in zip(layout.dims[level].tolist(), layout.first[level], strict=True)]
    z, y, x = torch.meshgrid(*reversed(axes), indexing="ij")
    return torch.stack([x, y, z], -1).reshape(-1, 3)


def _hashed(rows: Tensor, place: Tensor, size: int) -> Tensor:
    """[size, C] with each of ``rows`` [N, C] at its ``place`` [N]; the longest where several have the same one."""
    given = rows.cpu().numpy()
    rising = np.argsort(np.square(given).sum(1), kind="stable")
    out = np.zeros((size, given.shape[1]), given.dtype)
    out[place.numpy()[rising]] = given[rising]  # numpy keeps the last of equal places
    return torch.from_numpy(out).to(rows.device)


def table_rows(layout: GridLayout) -> int:
    """How many rows the table has."""
    return int(layout.size.sum())


def box_of_points(points: NDArray[np.floating], margin_m: float) -> NDArray[np.float64]:
    """Scene box [2, 3] around points [N, 3] with a margin; ignores the farthest 0.1 % on every side as outliers."""
    low, high = np.percentile(points.astype(np.float64), [0.1, 99.9], axis=0)
    side = math.sqrt(float(((high - low) ** 2).sum())) * 0.02
    return np.stack([low - margin_m - side, high + margin_m + side])
