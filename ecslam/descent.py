"""Levenberg-Marquardt on the sums of a surface, from a first guess of the pose to rest, coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from .kernels import AlignSettings, NormalEquations, Rules
from .pixels import Points

RULES = Rules(
    damping=1e-4, least_damping=1e-8, most_damping=1e4, settled=1e-4,
    still_after_gain=1e-5, still_after_loss=1e-6, least_used=6,
)  # fmt: skip
COARSE_STRIDE = 4


class Summable(Protocol):
    """Something that gives the sums of one Gauss-Newton step."""

    def normal_equations(self, c2w: NDArray[np.float64], points: Points, settings: AlignSettings) -> NormalEquations:
        """See ``kernels.reference.normal_equations``; the sums lie on the CPU."""
        ...


@dataclass(frozen=True)
class Alignment:
    """c2w: float64 [4, 4]. cost: robust objective per point, in squared metres."""

    c2w: NDArray[np.float64]
    cost: float


def descend(
    surface: Summable,
    points: Points,
    guess: NDArray[np.float64],
    settings: Sequence[AlignSettings],
    iterations: int,
) -> Alignment:
    """Levenberg-Marquardt from ``guess`` [4, 4] through all ``settings``, at most ``iterations`` steps with each; all
    stages but the last take every fourth point. The volumes do the same in kernels."""
    everything, c2w, total, cost = points, guess, 0, 0.0
    for stage in settings:
        points = everything if stage is settings[-1] else everything.every(COARSE_STRIDE)
        total = len(points.local)
        equations = surface.normal_equations(c2w, points, stage)
        damping = RULES.damping
        for _ in range(iterations):
            if equations.used < RULES.least_used:
                break
            jtj = equations.jtj.numpy()
            move = -np.linalg.solve(jtj + damping * np.diag(jtj.diagonal() + 1e-9), equations.jtr.numpy())
            trial = moved(c2w, move)
            found = surface.normal_equations(trial, points, stage)
            before, after = objective(equations, total, stage), objective(found, total, stage)
            size = float(np.abs(move).max())
            if after < before:
                c2w, equations, damping = trial, found, max(damping / 3, RULES.least_damping)
                if before - after < RULES.settled * before or size < RULES.still_after_gain:
                    break
            else:
                damping *= 10
                if damping > RULES.most_damping or size < RULES.still_after_loss:
                    break
        cost = objective(equations, total, stage)
    return Alignment(c2w, cost / max(total, 1))


def moved(c2w: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """``se3.retract`` of one pose [4, 4] by xi [6], without the cost of torch's small tensors."""
    out = c2w.copy()
    out[:3, :3] = cv2.Rodrigues(xi[3:])[0] @ c2w[:3, :3]
    out[:3, 3] += xi[:3]
    return out


def objective(equations: NormalEquations, total: int, settings: AlignSettings) -> float:
    """Robust cost in which a dropped point counts as an outlier, so that dropping points never pays."""
    return equations.cost + outlier_cost(settings) * (total - equations.used)


def outlier_cost(settings: AlignSettings) -> float:
    """What a point adds to the robust cost at most."""
    worst = settings.kernel_m**2
    if settings.colour_weight > 0:
        worst += (settings.colour_weight * settings.colour_kernel) ** 2
    return 0.5 * worst
