"""Depths along rays on a CPU (numba): one pass over the rays, where torch would take dozens over small tensors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ._cpu_depths import LEAST_DENSITY, importance_rows, sample_rows


def sample_depths(depth: Tensor, far: Tensor, jitter: Tensor, uniform: int, near_m: float, reach_m: float) -> Tensor:
    """See ``reference_depths.sample_depths``."""
    z = torch.empty(jitter.shape)
    lengths = np.float32(near_m), np.float32(reach_m)
    sample_rows(*(t.contiguous().numpy() for t in (depth, far, jitter)), uniform, *lengths, z.numpy())
    return z


def importance_depths(z: Tensor, weights: Tensor, jitter: Tensor) -> Tensor:
    """See ``reference_depths.importance_depths``."""
    out = torch.empty(len(z), z.shape[1] + jitter.shape[1])
    total = (weights[:, 1:-1] + float(LEAST_DENSITY)).sum(1)  # in torch's order, so that both find the same bits
    importance_rows(*(t.contiguous().numpy() for t in (z, weights, total, jitter)), out.numpy())
    return out
