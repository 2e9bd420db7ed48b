"""Levenberg-Marquardt on the fused TSDF volume (numba): all stages of ``descent.descend`` in one compiled loop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numba import njit

from ..compiled import drop_stale
from .fusion import INLINE, OPTIONS, align_sums


@njit(**INLINE)
def objective_at(blocks, c2w, points, light, voxel, settings, sums):
    """``descent.objective`` at c2w [4, 4]; sums: [45], see ``align_sums``."""
    _, kernel, _, _, _, colour, colour_kernel = settings
    sums[:] = 0
    align_sums(blocks, c2w, points, light, voxel, settings, sums)
    worst = kernel * kernel + colour * colour_kernel * (colour * colour_kernel)
    return sums[42] + 0.5 * worst * (points.shape[0] - sums[44])


@njit(**INLINE)
def damped_step(sums, damping, lower, move):
    """The step ``move`` [6] against the sums of ``align_sums``, by Cholesky's factor ``lower`` [6, 6] of the damped
    matrix; False where that is not positive."""
    for a in range(6):
        for b in range(a + 1):
            rest = sums[6 * b + a]
            if a == b:
                rest += damping * (rest + 1e-9)
            for k in range(b):
                rest -= lower[a, k] * lower[b, k]
            if b < a:
                lower[a, b] = rest / lower[b, b]
            elif rest > 0:
                lower[a, a] = np.sqrt(rest)
            else:
                return False
    for a in range(6):
        rest = -sums[36 + a]
        for k in range(a):
            rest -= lower[a, k] * move[k]
        move[a] = rest / lower[a, a]
    for a in range(5, -1, -1):
        rest = move[a]
        for k in range(a + 1, 6):
            rest -= lower[k, a] * move[k]
        move[a] = rest / lower[a, a]
    return True


@njit(**INLINE)
def retract(c2w, move, out):
    """``se3.retract`` of a pose [4, 4] by ``move`` [6] into the upper rows of ``out``."""
    w0, w1, w2 = move[3], move[4], move[5]
    angle = np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    scale = 1 / max(angle, 1e-200)
    w0, w1, w2 = w0 * scale, w1 * scale, w2 * scale
    c, s = np.cos(angle), np.sin(angle)
    for i in range(3):
        x, y, z = c2w[0, i], c2w[1, i], c2w[2, i]
        along = (1 - c) * (w0 * x + w1 * y + w2 * z)
        out[0, i] = c * x + s * (w1 * z - w2 * y) + w0 * along
        out[1, i] = c * y + s * (w2 * x - w0 * z) + w1 * along
        out[2, i] = c * z + s * (w0 * y - w1 * x) + w2 * along
        out[i, 3] = c2w[i, 3] + move[i]


@njit(**OPTIONS)
def descend(blocks, c2w, points, light, voxel, stages, iterations, coarse, rules):
    """The pose [4, 4] where a descent from c2w ends, and the objective there in the last stage.

    points: float32 [N, 3], in the camera; light: float32 [N]. stages: float64 [S, 7], the numbers of each
    ``AlignSettings``; all stages but the last take every ``coarse``-th point. A matrix that is not positive counts as
    a refused step.
    """
    best, trial = c2w.copy(), c2w.copy()
    sums, found = np.empty(45), np.empty(45)
    lower, move = np.empty((6, 6)), np.empty(6)
    cost = 0.0
    few, dim = points[::coarse].copy(), light[::coarse].copy()
    for n in range(stages.shape[0]):
        s = stages[n]
        settings = (s[0], s[1], s[2], s[3], s[4], s[5], s[6])
        if n == stages.shape[0] - 1:
            few, dim = points, light
        cost = objective_at(blocks, best, few, dim, voxel, settings, sums)
        damping = rules.damping
        for _ in range(iterations):
            if sums[44] < rules.least_used:
                break
            after, size = np.inf, np.inf
            if damped_step(sums, damping, lower, move):
                retract(best, move, trial)
                after, size = objective_at(blocks, trial, few, dim, voxel, settings, found), np.abs(move).max()
            if after < cost:
                settled = cost - after < rules.settled * cost
                best, trial, sums, found, cost = trial, best, found, sums, after
                damping = max(damping / 3, rules.least_damping)
                if settled or size < rules.still_after_gain:
                    break
            else:
                damping *= 10
                if damping > rules.most_damping or size < rules.still_after_loss:
                    break
    return best, cost


drop_stale(Path(__file__).parent, descend.stats.cache_path, "fusion*")
