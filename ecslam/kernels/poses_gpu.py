"""Steps of Adam for rigid poses on a GPU."""

from __future__ import annotations

import torch
from torch import Tensor

from ._gpu_device import beside
from ._gpu_poses import pose_kernel
from .types import PoseMoments

BLOCK = 4  # poses; few, since a warp reads 32 of them one cache line each


def pose_step(c2w: Tensor, d_c2w: Tensor, moments: PoseMoments, rates: Tensor, count: int) -> Tensor:
    """See ``reference.pose_step``. Never waits for the device."""
    moved, poses, decays, about = torch.empty_like(c2w), len(c2w), moments.decays, moments.about
    rest, scale = tuple(1 - decay for decay in decays), tuple(1 / (1 - decay**count) for decay in decays)
    with beside(c2w):
        pose_kernel[(-(-poses // BLOCK),)](
            c2w, d_c2w, moments.mean, moments.square, rates, rates if about is None else about, moved, poses,
            decays, rest, scale, moments.epsilon, turns_about=about is not None, block=BLOCK, num_warps=1,
        )  # fmt: skip
    return moved
