"""Tracking: the pose of one frame against the fixed map (paper, section III-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from .align import Surface, align, known_points, transform
from .config import Config
from .field import TsdfField
from .kernels import LOSS_NAMES, Backend
from .pixels import Pixels
from .pose_adam import PoseAdam
from .rays import kernel_weights, make_rays
from .samples import resample_missing

LEAST_SEEN = 0.1


@dataclass(frozen=True)
class TrackResult:
    """c2w: float64 [4, 4], the best iterate. losses: weighted terms there. fit: how well the surface explains the frame
    (see ``fit``; near 0 = lost)."""

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
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """The paper's tracking: Adam on the rendered losses from ``guess`` [4, 4]; pixels are sampled once and only
    transformed in each iteration. Returns the iterate [4, 4] with the least loss and the weighted terms there."""
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
    return c2w, dict(zip(LOSS_NAMES, best_terms.tolist(), strict=True))


def fit(surface: Surface, pixels: Pixels, c2w: NDArray[np.float64], truncation_m: float) -> float:
    """Share of the measured points, among those where the surface is known, that lie within half a truncation of it,
    seen from c2w [4, 4]; 0 where next to nothing is known."""
    distance, known = surface.distances(transform(c2w, pixels.points()))
    if known.sum() < LEAST_SEEN * max(len(known), 1):
        return 0.0
    return float((np.abs(distance[known]) < 0.5 * truncation_m).mean())


def track_direct(surface: Surface, pixels: Pixels, guess: NDArray[np.float64], config: Config) -> TrackResult:
    """Our own tracking: direct alignment to ``surface`` from ``guess`` [4, 4]."""
    found = align(surface, known_points(surface, pixels, guess), guess, config)
    quality = fit(surface, pixels, found.c2w, config.truncation_m)
    return TrackResult(found.c2w, {"align_mm": 1e3 * found.cost**0.5}, quality)
