"""Tracking: the pose of one frame against the fixed map (paper, section III-B)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from .align import align
from .config import Config
from .field import TsdfField
from .kernels import LOSS_NAMES, AlignSettings, Backend
from .pixels import Pixels
from .pose_adam import PoseAdam
from .rays import kernel_weights, make_rays
from .samples import resample_missing

WIDE_GRADIENT = (0.3, 2.0)
_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32) / 255


@dataclass(frozen=True)
class TrackResult:
    """c2w: float64 [4, 4], the best iterate. losses: weighted terms there. fit: share of the measured points that lie
    within half a truncation of the map's surface (1 = the map explains the frame, near 0 = lost)."""

    c2w: NDArray[np.float64]
    losses: dict[str, float]
    fit: float


def track_adam(
    field: TsdfField,
    kernels: Backend,
    pixels: Pixels,
    guess: NDArray[np.float64],
    config: Config,
    generator: torch.Generator,
) -> TrackResult:
    """The paper's tracking: Adam on the rendered losses from ``guess`` [4, 4]; pixels are sampled once and only
    transformed in each iteration; the iterate with the least loss is kept."""
    t, device = config.tracking, field.device
    optimiser = PoseAdam(torch.from_numpy(guess)[None].to(device), t.lr_rotation, t.lr_translation)
    pose = np.zeros(len(pixels), np.int64)
    rays = make_rays(pixels, pose, optimiser.c2w, field.layout.box, config, generator, device)
    rays = resample_missing(rays, optimiser.c2w.float(), field, kernels, config.sampling, generator)
    weights = kernel_weights(t.loss, config)
    best = optimiser.c2w
    best_terms = torch.full((len(LOSS_NAMES),), torch.inf, device=device)
    for _ in range(t.iterations):
        result = kernels.step(field.layout, field.params, optimiser.c2w.float(), rays, weights, None, True)
        better = result.losses.sum() < best_terms.sum()
        best = torch.where(better, optimiser.c2w, best)
        best_terms = torch.where(better, result.losses, best_terms)
        assert result.d_c2w is not None
        optimiser.step(result.d_c2w)
    c2w = best[0].cpu().numpy()
    losses = dict(zip(LOSS_NAMES, best_terms.tolist(), strict=True))
    return TrackResult(c2w, losses, fit(field, kernels, pixels, c2w))


def fit(field: TsdfField, kernels: Backend, pixels: Pixels, c2w: NDArray[np.float64]) -> float:
    """Share of measured points whose |TSDF| in the map is below one half, seen from c2w [4, 4]."""
    points = pixels.points()
    if len(points) == 0:
        return 0.0
    world = (points @ c2w[:3, :3].T + c2w[:3, 3]).astype(np.float32)
    sdf, _ = kernels.values(field.layout, field.params, torch.from_numpy(world).to(field.device))
    return float((sdf.abs() < 0.5).float().mean())


def track_direct(
    field: TsdfField, kernels: Backend, pixels: Pixels, guess: NDArray[np.float64], config: Config
) -> TrackResult:
    """Our own tracking: Levenberg-Marquardt on the TSDF at the measured points, from ``guess`` [4, 4]."""
    t = config.tracking
    has = pixels.depth > 0
    points = torch.from_numpy(pixels.points()).to(field.device)
    luminance = torch.from_numpy(pixels.color[has].astype(np.float32) @ _LUMINANCE).to(field.device)
    wide = AlignSettings(
        truncation_m=config.truncation_m,
        kernel_m=0.0,
        tsdf_limit=t.tsdf_limit,
        gradient_low=WIDE_GRADIENT[0],
        gradient_high=WIDE_GRADIENT[1],
        colour_weight=t.colour_weight_m,
        colour_kernel=t.colour_kernel,
    )
    stages = [replace(wide, kernel_m=kernel) for kernel in t.kernels_m]
    low, high = t.gradient_range
    stages[-1] = replace(stages[-1], gradient_low=low, gradient_high=high)
    found = align(field, kernels, points, luminance, guess, stages, t.iterations)
    return TrackResult(found.c2w, {"align_mm": 1e3 * found.cost**0.5}, fit(field, kernels, pixels, found.c2w))
