"""Depth L1: how much two surfaces differ as seen from virtual cameras inside the scene (as in NICE-SLAM, Co-SLAM).

As there: 1,000 views of 500 x 500 pixels with a focal length of 300 pixels, at random places in the middle of the
scene's box (30 % of its height, 70 % of its other sides), looking in random directions; the mean over the views of a
view's mean absolute difference. Only pixels where the reference has a surface count; where the estimate has none, its
depth is 0.

What differs: places are drawn where a camera saw free space, so never inside furniture or walls and in every room of a
flat (there: one box for each scene, moved by hand); pixels where the reference shows what no camera saw don't count (a
face with an unseen corner does not), and a view with more than half such or empty pixels is left out (there: one with
any unseen vertex in its frustum, even behind a wall; where occluded parts count as unseen hardly a view would be left).
The estimate keeps what lay in a camera's frustum, hidden or not: in Co-SLAM's protocol virtual cameras keep what can be
seen from inside the scene, which for these views comes to the same.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels.raster import rasterize
from ..types import Intrinsics, Mesh
from .culling import WORKERS

CAMERA = Intrinsics(300.0, 300.0, 249.5, 249.5, 500, 500)
SEEN_SHARE = 0.5
TRIES_PER_VIEW = 10

Poses = NDArray[np.float64]


@dataclass(frozen=True)
class DepthError:
    """cm: mean over the views that count. views: how many did."""

    cm: float
    views: int


def viewpoint_candidates(
    bounds: NDArray[np.floating], up: NDArray[np.floating], count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Places [count, 3] in the middle of a scene box [2, 3]: 0.3 of its side along ``up`` [3], 0.7 of the others."""
    share = np.full(3, 0.7)
    share[np.abs(up).argmax()] = 0.3
    middle, half = np.mean(bounds, 0), np.diff(bounds, axis=0)[0] / 2
    return middle + share * half * rng.uniform(-1, 1, (count, 3))


def random_views(places: NDArray[np.float64], up: NDArray[np.floating], rng: np.random.Generator) -> Poses:
    """Poses [N, 4, 4] at places [N, 3] that look in random directions with ``up`` [3] upwards in the image."""
    z = rng.normal(size=(len(places), 3))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(-np.asarray(up, np.float64), z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2], poses[:, :3, 3] = x, np.cross(z, x), z, places
    return poses


def up_direction(poses: Poses) -> NDArray[np.float64]:
    """Where the top of the image points on average over finite poses [N, 4, 4]: a unit vector [3]."""
    up = -poses[:, :3, 1].mean(0)
    return np.asarray(up / max(float(np.linalg.norm(up)), 1e-12))


def depth_l1(
    estimate: Mesh,
    reference: Mesh,
    reference_seen: NDArray[np.bool_],
    views: Poses,
    wanted: int,
    *,
    intrinsics: Intrinsics = CAMERA,
    progress: Callable[[float], None] | None = None,
) -> DepthError | None:
    """Mean absolute difference of depth over the first ``wanted`` of the views [N, 4, 4] that count; None if none does.

    reference: the whole of it, with bool [F] telling which faces cameras saw whole. estimate: already culled.
    """

    def difference(c2w: NDArray[np.float64]) -> float | None:
        depth, face = rasterize(reference, intrinsics, c2w)
        valid = (face >= 0) & reference_seen[face]
        if valid.mean() < SEEN_SHARE:
            return None
        return float(np.abs(depth - rasterize(estimate, intrinsics, c2w)[0])[valid].mean())

    errors: list[float] = []
    with ThreadPoolExecutor(WORKERS) as pool:
        for start in range(0, len(views), 4 * WORKERS):
            errors += [e for e in pool.map(difference, views[start : start + 4 * WORKERS]) if e is not None]
            if progress is not None:
                progress(min(1.0, max(len(errors) / wanted, start / len(views))))
            if len(errors) >= wanted:
                break
    errors = errors[:wanted]
    return DepthError(100 * float(np.mean(errors)), len(errors)) if errors else None
