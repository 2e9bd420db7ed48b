"""Direct alignment: Levenberg-Marquardt on a signed distance itself, one sample per pixel at its measured depth (ours).

A step costs one pass over the points instead of a rendering, so a frame needs milliseconds. Damping and step control
keep it from diverging on plain walls and fast turns; the luminance term holds what geometry leaves free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from .config import Config
from .descent import Alignment, descend, objective
from .field import TsdfField
from .kernels import AlignSettings, Backend, NormalEquations
from .observed import ObservedVoxels
from .pixels import LUMINANCE, Pixels, Points

WIDE_GRADIENT = (0.3, 2.0)
LEAST_KNOWN = 100


class Surface(Protocol):
    """Something with a signed distance that points can be aligned to: the fused volume or the learned map."""

    def distances(self, points: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Signed distance [N] in metres at world points [N, 3], and whether it is known there."""
        ...

    def normal_equations(self, c2w: NDArray[np.float64], points: Points, settings: AlignSettings) -> NormalEquations:
        """See ``kernels.reference.normal_equations``; the sums lie on the CPU."""
        ...

    def descend(
        self, points: Points, guess: NDArray[np.float64], settings: Sequence[AlignSettings], iterations: int
    ) -> Alignment:
        """See ``descent.descend``."""
        ...


@dataclass(frozen=True)
class LearnedSurface:
    """The learned map as a ``Surface``; known where it has been observed."""

    field: TsdfField
    kernels: Backend
    truncation_m: float
    observed: ObservedVoxels

    def distances(self, points: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """See ``Surface``."""
        at = torch.from_numpy(points.astype(np.float32)).to(self.field.device)
        sdf, _ = self.kernels.values(self.field.layout, self.field.params, at)
        return sdf.cpu().numpy() * np.float32(self.truncation_m), self.observed.contains(points)

    def normal_equations(self, c2w: NDArray[np.float64], points: Points, settings: AlignSettings) -> NormalEquations:
        """See ``Surface``."""
        device, layout, params = self.field.device, self.field.layout, self.field.params
        pose = torch.from_numpy(c2w).float().to(device)
        local, light = points.local.to(device), points.light.to(device)
        found = self.kernels.normal_equations(layout, params, pose, local, light, settings)
        return replace(found, jtj=found.jtj.cpu(), jtr=found.jtr.cpu())

    def descend(
        self, points: Points, guess: NDArray[np.float64], settings: Sequence[AlignSettings], iterations: int
    ) -> Alignment:
        """See ``Surface``."""
        return descend(self, points, guess, settings, iterations)


def stages(config: Config) -> list[AlignSettings]:
    """The settings of each stage, coarse to fine; the last one trusts the narrow range of gradient norms."""
    a = config.align
    wide = AlignSettings(
        truncation_m=config.truncation_m,
        kernel_m=0.0,
        tsdf_limit=a.tsdf_limit,
        gradient_low=WIDE_GRADIENT[0],
        gradient_high=WIDE_GRADIENT[1],
        colour_weight=a.colour_weight_m,
        colour_kernel=a.colour_kernel,
    )
    out = [replace(wide, kernel_m=kernel) for kernel in a.kernels_m]
    low, high = a.gradient_range
    out[-1] = replace(out[-1], gradient_low=low, gradient_high=high)
    return out


def known_points(surface: Surface, pixels: Pixels, guess: NDArray[np.float64], gain: float = 1.0) -> Points:
    """The measured points of ``pixels`` that lie, seen from ``guess`` [4, 4], where the surface is known; all of them
    when that leaves too few. gain: of their luminance, which is cut off at 1."""
    local, color = pixels.points(), pixels.color[pixels.depth > 0]
    light = np.minimum(color.astype(np.float32) @ (LUMINANCE * np.float32(gain)), np.float32(1))
    _, known = surface.distances(transform(guess, local))
    if known.sum() >= LEAST_KNOWN:
        local, light = local[known], light[known]
    return Points(torch.from_numpy(local), torch.from_numpy(light))


def align(surface: Surface, points: Points, guess: NDArray[np.float64], config: Config) -> Alignment:
    """Move ``points`` from ``guess`` [4, 4] onto the surface, coarse to fine."""
    return surface.descend(points, guess, stages(config), config.align.iterations)


def cost_at(surface: Surface, points: Points, c2w: NDArray[np.float64], config: Config) -> float:
    """What ``align`` minimises in its last stage, at c2w [4, 4]: robust, per point, in squared metres."""
    last = stages(config)[-1]
    found = surface.normal_equations(c2w, points, last)
    return objective(found, len(points.local), last) / max(len(points.local), 1)


def transform(c2w: NDArray[np.float64], points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Camera points [N, 3] in the world of c2w [4, 4]."""
    return points @ c2w[:3, :3].T + c2w[:3, 3]
