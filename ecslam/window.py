"""Effectively constrained bundle adjustment (EBA): which keyframes take part, from poses alone.

Paper, section III-B: drop keyframes whose viewing direction differs much from the current one, order the rest by the
distance of optical centres, cap the number by the ray budget, and always keep recent and historic keyframes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .config import WindowConfig
from .indices import evenly

RAYS_PER_KEYFRAME = 32


def parallax(keyframes: NDArray[np.float64], current: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Optical-centre distance [K] in metres and viewing-direction angle [K] in degrees to the current pose [4, 4]."""
    distance = np.linalg.norm(keyframes[:, :3, 3] - current[:3, 3], axis=1)
    cosine = keyframes[:, :3, 2] @ current[:3, 2]
    return distance, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def select_window(
    keyframes: NDArray[np.float64], current: NDArray[np.float64], rays: int, config: WindowConfig
) -> NDArray[np.int64]:
    """Ascending indices of the chosen keyframes, given their poses [K, 4, 4], oldest first.

    Deterministic. At most min(config.size, rays // 32) of them; the last ``recent`` and ``historic`` ones spread evenly
    over the past (the first always among them) are in whatever their angle; the nearest of the others fill the rest.
    """
    count = len(keyframes)
    cap = max(2, min(config.size, rays // RAYS_PER_KEYFRAME))
    if count <= cap:
        return np.arange(count)
    recent = min(config.recent, cap - 1)
    chosen = np.zeros(count, np.bool_)
    chosen[count - recent :] = True
    chosen[evenly(count - recent, min(config.historic, cap - recent))] = True
    distance, angle = parallax(keyframes, current)
    order = np.argsort(distance, kind="stable")
    near = order[((angle <= config.max_angle_deg) & ~chosen)[order]]
    chosen[near[: cap - np.count_nonzero(chosen)]] = True
    return np.flatnonzero(chosen)


def random_window(count: int, rays: int, config: WindowConfig, rng: np.random.Generator) -> NDArray[np.int64]:
    """The ablation without EBA: a random number of random keyframes; the current one (the last) is always in."""
    cap = max(2, min(config.size, rays // RAYS_PER_KEYFRAME, count))
    if count <= 1:
        return np.arange(count)
    others = rng.choice(count - 1, rng.integers(1, cap), replace=False)
    return np.union1d(others, [count - 1])
