"""Distances between two surfaces: Accuracy, Completion, Completion Ratio (as in iMAP, NICE-SLAM and Co-SLAM)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .trajectory import Similarity, align_umeyama

RATIO_THRESHOLD_M = 0.05
Points = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceError:
    """accuracy_cm: mean distance from the estimate to the reference. completion_cm: the other way round.

    completion_ratio: share of the reference in per cent with the estimate nearer than 5 cm.
    """

    accuracy_cm: float
    completion_cm: float
    completion_ratio: float


def surface_error(estimate: Points, reference: Points) -> SurfaceError:
    """Compare surface samples [N, 3] and [M, 3] in metres, neither empty (the papers take 200,000 of each).

    The distances are between samples, so two equal surfaces are as far apart as their samples are dense.
    """
    to_reference = cKDTree(reference).query(estimate, workers=-1)[0]
    to_estimate = cKDTree(estimate).query(reference, workers=-1)[0]
    ratio = 100 * float(np.mean(to_estimate < RATIO_THRESHOLD_M))
    return SurfaceError(100 * float(to_reference.mean()), 100 * float(to_estimate.mean()), ratio)


def register(source: Points, target: Points, *, threshold_m: float = 0.1, iterations: int = 30) -> Similarity:
    """The rigid motion that brings samples [N, 3] onto others [M, 3]: point-to-point ICP from the identity.

    Pairs further apart than threshold_m do not count. Stops when the mean squared distance no longer falls by 1e-6 of
    itself. NICE-SLAM and Co-SLAM register every map like this before they measure it.
    """
    tree = cKDTree(target)
    motion = Similarity(np.eye(3), np.zeros(3))
    before = np.inf
    for _ in range(iterations):
        distance, nearest = tree.query(motion.apply(source), distance_upper_bound=threshold_m, workers=-1)
        near = np.isfinite(distance)
        if near.sum() < 3:
            break
        square = float(np.mean(distance[near] ** 2))
        if square >= before * (1 - 1e-6):
            break
        before = square
        motion = align_umeyama(source[near], target[nearest[near]])
    return motion
