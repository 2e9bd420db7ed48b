"""Direct alignment: Levenberg-Marquardt on the TSDF itself, one sample per pixel at its measured depth (ours).

A step costs one fused pass over the points instead of a rendering, so a frame needs milliseconds. Damping and step
control keep it from diverging on plain walls and fast turns; the luminance term holds what geometry leaves free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from . import se3
from .field import TsdfField
from .kernels import AlignSettings, Backend, NormalEquations

DAMPING = (1e-4, 1e-8, 1e4)


@dataclass(frozen=True)
class Alignment:
    """c2w: float64 [4, 4]. cost: robust objective per point, in squared metres."""

    c2w: NDArray[np.float64]
    cost: float


def align(
    field: TsdfField,
    kernels: Backend,
    points: Tensor,
    luminance: Tensor,
    guess: NDArray[np.float64],
    stages: Sequence[AlignSettings],
    iterations: int,
) -> Alignment:
    """Move camera points [N, 3] (metres, luminance [N] in 0..1) from ``guess`` [4, 4] onto the map's surface.

    Coarse to fine through ``stages``, at most ``iterations`` steps in each.
    """
    c2w = torch.from_numpy(guess)
    total = len(points)
    equations, stage = None, stages[0]
    for stage in stages:
        equations = _evaluate(field, kernels, c2w, points, luminance, stage)
        damping = DAMPING[0]
        for _ in range(iterations):
            if equations.used < 6:
                break
            diagonal = torch.diag(equations.jtj.diagonal() + 1e-9)
            move = -torch.linalg.solve(equations.jtj + damping * diagonal, equations.jtr)
            trial = se3.retract(c2w, move)
            found = _evaluate(field, kernels, trial, points, luminance, stage)
            before, after = _objective(equations, total, stage), _objective(found, total, stage)
            if after < before:
                c2w, equations, damping = trial, found, max(damping / 3, DAMPING[1])
                if before - after < 1e-5 * before or float(move.abs().max()) < 1e-5:
                    break
            else:
                damping *= 10
                if damping > DAMPING[2] or float(move.abs().max()) < 1e-6:
                    break
    assert equations is not None
    return Alignment(c2w.numpy(), _objective(equations, total, stage) / max(total, 1))


def _evaluate(
    field: TsdfField, kernels: Backend, c2w: Tensor, points: Tensor, luminance: Tensor, settings: AlignSettings
) -> NormalEquations:
    pose = c2w.to(points)
    return kernels.normal_equations(field.layout, field.params, pose, points, luminance, settings)


def _objective(equations: NormalEquations, total: int, settings: AlignSettings) -> float:
    """Robust cost in which a dropped point counts as an outlier, so that dropping points never pays."""
    worst = settings.kernel_m**2
    if settings.colour_weight > 0:
        worst += (settings.colour_weight * settings.colour_kernel) ** 2
    return equations.cost + 0.5 * worst * (total - equations.used)
