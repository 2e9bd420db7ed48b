"""From chosen pixels and poses to the batch of rays the kernels render."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .config import Config, LossWeights
from .kernels import Backend, DevicePixels, RayBatch, Weights
from .pixels import Pixels
from .samples import ray_exit


def upload(pixels: Pixels, device: torch.device) -> DevicePixels:
    """The same pixels on ``device``, without waiting for it."""
    direction = np.pad(pixels.direction, ((0, 0), (0, 1)), constant_values=1)
    columns = (direction, pixels.depth, pixels.color, pixels.feature)
    return DevicePixels(*(torch.from_numpy(column).to(device, non_blocking=True) for column in columns))


def gather(views: Sequence[Pixels], picks: Sequence[NDArray[np.int64]]) -> Pixels:
    """The pixels that are picked [N, R_i] of each view, N times those of all views one after another."""
    columns = (
        np.concatenate([getattr(view, f.name)[pick] for view, pick in zip(views, picks, strict=True)], 1)
        for f in fields(Pixels)
    )
    return Pixels(*(column.reshape(-1, *column.shape[2:]) for column in columns))


def make_rays(
    pixels: DevicePixels,
    row: Tensor,
    c2w: Tensor,
    box: Tensor,
    kernels: Backend,
    config: Config,
    jitter: Tensor,
    missing: bool,
) -> RayBatch:
    """Rays of ``pixels`` with their sample depths, never waiting for the device.

    row: [R] says which of the poses c2w [P, 4, 4] each ray belongs to. box: [2, 3] metres. jitter: [R, S] in 0..1.
    missing: whether some have no depth, and so end where they leave the box.
    """
    s, far = config.sampling, torch.full_like(pixels.depth, config.depth_far_m)
    if missing:
        poses = c2w.to(far).index_select(0, row)
        world = (poses[:, :3, :3] * pixels.direction[:, None, :]).sum(-1)
        far = ray_exit(poses[:, :3, 3], world, box, config.depth_far_m)
    return RayBatch(
        direction=pixels.direction,
        z=kernels.sample_depths(pixels.depth, far, jitter, s.uniform, s.near_m, s.depth_range_m),
        depth=pixels.depth,
        color=_fractions(pixels.color),
        feature=pixels.feature,
        pose=row,
    )


def _fractions(color: Tensor) -> Tensor:
    """uint8 as float32 in 0..1. numpy does it alone, torch wakes its threads, which a busy CPU keeps it waiting for."""
    return torch.from_numpy(color.numpy() / np.float32(255)) if color.device.type == "cpu" else color.float() / 255


def view_centre(rays: RayBatch) -> Tensor:
    """The middle of what rays of one view measured: float64 [3], camera coordinates in metres; the camera itself where
    no ray has a depth."""
    has = (rays.depth > 0)[:, None].double()
    return (has * rays.direction * rays.depth[:, None]).sum(0) / has.sum().clamp_min(1)


def kernel_weights(loss: LossWeights, config: Config) -> Weights:
    """The kernels' view of the loss weights, which have the same names there."""
    return Weights(**vars(loss), truncation_m=config.truncation_m, centre_share=config.centre_share)
