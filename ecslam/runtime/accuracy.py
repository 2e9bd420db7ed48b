"""The ATE while a run goes on, cheap enough to be asked for every few frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Ate:
    """Absolute trajectory error in centimetres, after rigid alignment."""

    rmse_cm: float
    mean_cm: float
    max_cm: float


def ate(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> Ate | None:
    """ATE of camera centres of poses [N, 4, 4], aligned rigidly (Umeyama 1991, without scale).

    Frames whose truth is not finite are left out; None when fewer than three remain.
    """
    known = np.isfinite(truth).all((1, 2))
    if known.sum() < 3:
        return None
    a, b = estimate[known, :3, 3], truth[known, :3, 3]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    u, _, vt = np.linalg.svd(b0.T @ a0)
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    error = 100 * np.linalg.norm(a0 @ rotation.T - b0, axis=1)
    return Ate(float(np.sqrt((error**2).mean())), float(error.mean()), float(error.max()))


def pose_error(c2w: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[float, float]:
    """Distance in centimetres and angle in degrees between two poses [4, 4]."""
    cosine = 0.5 * (np.trace(c2w[:3, :3].T @ truth[:3, :3]) - 1)
    distance = 100 * float(np.linalg.norm(c2w[:3, 3] - truth[:3, 3]))
    return distance, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
