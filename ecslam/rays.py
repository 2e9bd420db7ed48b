"""From chosen pixels and poses to the batch of rays the kernels render."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .config import Config, LossWeights
from .kernels import RayBatch, Weights
from .pixels import Pixels
from .samples import ray_exit, sample_depths


def gather(views: Sequence[Pixels], picks: Sequence[NDArray[np.int64]]) -> tuple[Pixels, NDArray[np.int64]]:
    """The picked pixels of all views in one, and the view number [R] of each, ascending."""
    taken = [view.take(pick) for view, pick in zip(views, picks, strict=True)]
    joined = Pixels(
        np.concatenate([t.direction for t in taken]),
        np.concatenate([t.depth for t in taken]),
        np.concatenate([t.color for t in taken]),
        np.concatenate([t.feature for t in taken]),
    )
    return joined, np.repeat(np.arange(len(taken)), [len(t) for t in taken])


def make_rays(
    pixels: Pixels,
    pose: NDArray[np.int64],
    c2w: Tensor,
    box: Tensor,
    config: Config,
    generator: torch.Generator,
    device: torch.device,
) -> RayBatch:
    """Rays of ``pixels`` with their sample depths. pose [R] says which row of c2w [P, 4, 4] each ray belongs to."""
    direction = torch.nn.functional.pad(torch.from_numpy(pixels.direction), (0, 1), value=1.0).to(device)
    depth = torch.from_numpy(pixels.depth).to(device)
    row = torch.from_numpy(pose).to(device)
    far = torch.full_like(depth, config.depth_far_m)
    missing = depth <= 0
    if missing.any():
        poses = c2w.to(direction)[row[missing]]
        world = torch.einsum("rij,rj->ri", poses[:, :3, :3], direction[missing])
        far[missing] = ray_exit(poses[:, :3, 3], world, box.to(direction), config.depth_far_m)
    return RayBatch(
        direction=direction,
        z=sample_depths(depth, far, config.sampling, generator),
        depth=depth,
        color=torch.from_numpy(pixels.color).to(device).float() / 255,
        feature=torch.from_numpy(pixels.feature).to(device),
        pose=row,
    )


def kernel_weights(loss: LossWeights, config: Config) -> Weights:
    """The kernels' view of the loss weights."""
    return Weights(
        loss.free_space,
        loss.centre,
        loss.tail,
        loss.depth_uniform,
        loss.depth_feature,
        loss.colour_uniform,
        loss.colour_feature,
        config.truncation_m,
        config.centre_share,
    )
