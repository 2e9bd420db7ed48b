"""Joint adjustment of all views' poses and of the camera: surfaces that several views see must coincide.

Points of one view are held against the planes that another one sees in their direction (projective association, as
KinectFusion's, but between all views that overlap); Gauss-Newton with a robust kernel that narrows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..descent import moved as moved_pose
from ..indices import evenly
from ..rigid import inverse
from ..types import Calibration
from ..window import parallax
from .cells import PARAMETERS, Cells, Surface, difference, moved, project, surface

NEIGHBOURS, OTHERS = 3, 8  # views that each is compared with: before it, and of the rest
SHARED_DEG, SHARED_M = 60.0, 2.0
KERNELS_M = (0.03, 0.02, 0.012, 0.006)  # the last one until all is at rest
ITERATIONS, AT_REST = 20, 5e-4
NOISE_M, NOISE_PER_M = 0.003, 0.003  # standard deviation of a point along its ray: near, and more by distance squared
NEAR_M, FACING, OFF_M, LEAST_SHARED = 0.1, 0.7, 0.3, 20
USUAL = np.array([0.05, 10.0, 10.0, 0.1, 0.05])  # standard deviations of the parameters before anything is known
LEAST_DAMPING, TINY = 1e-6, 1e-9
GROUPS = [0], [1, 2], [3], [4]
RESOLVED, WORTH = np.array([0.01, 5.0, 5.0, 0.02, 0.004]), 0.02


class Sums(NamedTuple):
    """Of all pairs of views: normal equations [6 V + 5, 6 V + 5], [6 V + 5]; robustly weighted squares; how many
    residuals, and the sum of their sizes in metres."""

    jtj: NDArray[np.float64]
    jtr: NDArray[np.float64]
    squares: float
    used: int
    size_m: float


@dataclass(frozen=True)
class Joint:
    """poses: [V, 4, 4] camera to world. calibration: the camera's. apart_m: how far surfaces lie apart, on the mean.
    spread: [5, 5] covariance of the camera's parameters if robustly weighted squares had the sum 1."""

    poses: NDArray[np.float64]
    calibration: Calibration
    apart_m: float
    spread: NDArray[np.float64]


def adjust(
    views: Sequence[Cells],
    poses: NDArray[np.float64],
    start: Calibration,
    given: Calibration,
    free: NDArray[np.bool_],
    watch: Callable[[], None],
) -> Joint:
    """Move poses [V, 4, 4], the first one fixed, and the ``free`` [5] parameters of the camera until surfaces coincide.

    start: where to begin; given: what the parameters are expected to be near. watch: called after each iteration.
    """
    poses, seen, count = poses.copy(), start, 6 * len(views)
    moving = np.concatenate([np.arange(6, count), count + np.flatnonzero(free)])
    unknown = count + np.arange(PARAMETERS)
    for iteration in range(ITERATIONS):
        kernel_m = KERNELS_M[min(iteration, len(KERNELS_M) - 1)]
        sums = _sums(views, poses, seen, kernel_m)
        jtj, jtr = sums.jtj, sums.jtr
        jtj[unknown, unknown] += 1 / USUAL**2
        jtr[unknown] += difference(seen, given) / USUAL**2
        system = jtj[np.ix_(moving, moving)]
        system[np.diag_indices_from(system)] *= 1 + LEAST_DAMPING
        system[np.diag_indices_from(system)] += LEAST_DAMPING
        step = np.zeros(count + PARAMETERS)
        step[moving] = -np.linalg.solve(system, jtr[moving])
        step /= max(1.0, np.abs(step[count:] / USUAL).max())
        poses = np.stack([moved_pose(pose, xi) for pose, xi in zip(poses, step[:count].reshape(-1, 6), strict=True)])
        seen = moved(seen, step[count:])
        watch()
        step[count:] /= USUAL
        if iteration >= len(KERNELS_M) and np.abs(step).max() < AT_REST:
            break
    spread = np.zeros((PARAMETERS, PARAMETERS))
    spread[np.ix_(free, free)] = max(sums.squares, TINY) * np.linalg.inv(system)[count - 6 :, count - 6 :]
    return Joint(poses, seen, sums.size_m / max(sums.used, 1), spread)


class Verdict(NamedTuple):
    """Of each parameter [5]: told: whether the views tell it; wrong: whether they tell that it is not as given."""

    told: NDArray[np.bool_]
    wrong: NDArray[np.bool_]


def verdict(change: NDArray[np.float64], spread: NDArray[np.float64]) -> Verdict:
    """What the views say of each parameter, given its ``change`` [5] and their ``spread`` [5, 5] when all are free.

    One after the other is set back, and the rest follows: first those that squares larger by the share ``WORTH`` would
    leave less certain than ``RESOLVED``, which are not told; then those without which they would grow by less. The
    centre's two go together.
    """
    told, wrong = np.ones(PARAMETERS, bool), np.ones(PARAMETERS, bool)
    left = [*GROUPS]

    def uncertain(rows: list[int]) -> float:
        return float((np.sqrt(WORTH * spread[rows, rows]) / RESOLVED[rows]).max())

    def worth(rows: list[int]) -> float:
        return float(change[rows] @ np.linalg.solve(spread[np.ix_(rows, rows)], change[rows]))

    while left:
        vaguest, least = max(left, key=uncertain), min(left, key=worth)
        vague = uncertain(vaguest) > 1
        if not vague and worth(least) >= WORTH:
            break
        rows = vaguest if vague else least
        told[rows], wrong[rows] = not vague, False
        follow = spread[:, rows] @ np.linalg.inv(spread[np.ix_(rows, rows)])
        change, spread = change - follow @ change[rows], spread - follow @ spread[rows]
        left.remove(rows)
    return Verdict(told, wrong)


def _pairs(poses: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Views that probably see the same, each pair both ways round."""
    found = set()
    for i, pose in enumerate(poses):
        distance, angle = parallax(poses, pose)
        others = np.flatnonzero((angle < SHARED_DEG) & (distance < SHARED_M))
        others = others[np.abs(others - i) > NEIGHBOURS]
        for j in (*range(max(i - NEIGHBOURS, 0), i), *others[evenly(len(others), OTHERS)]):
            found |= {(i, int(j)), (int(j), i)}
    return sorted(found)


def _sums(views: Sequence[Cells], poses: NDArray[np.float64], seen: Calibration, kernel_m: float) -> Sums:
    surfaces = [surface(view, seen) for view in views]
    spread_out = [each.taken(view.apart) for each, view in zip(surfaces, views, strict=True)]
    size = 6 * len(views) + PARAMETERS
    jtj, jtr = np.zeros((size, size)), np.zeros(size)
    unknown = np.arange(size - PARAMETERS, size)
    squares, used, size_m = 0.0, 0, 0.0
    for i, j in _pairs(poses):
        pair = _residuals(spread_out[i], surfaces[j], views[j], poses[i], poses[j], seen, kernel_m)
        if pair is None:
            continue
        jacobian, residual, weight = pair
        weighted = jacobian * weight[:, None]
        place = np.concatenate([np.arange(6 * i, 6 * i + 6), np.arange(6 * j, 6 * j + 6), unknown])
        jtj[np.ix_(place, place)] += weighted.T @ jacobian
        jtr[place] += weighted.T @ residual
        squares += float(weight @ residual**2)
        used += len(residual)
        size_m += float(np.abs(residual).sum())
    return Sums(jtj, jtr, squares, used, size_m)


def _residuals(
    of: Surface,
    on: Surface,
    view: Cells,
    of_c2w: NDArray[np.float64],
    on_c2w: NDArray[np.float64],
    seen: Calibration,
    kernel_m: float,
) -> tuple[NDArray[np.float64], ...] | None:
    """How far points of one view lie before the planes ``on`` another ``view``: by the motions of both, translation and
    rotation about each camera in the world, and by the camera's parameters [n, 17]; itself [n], metres; weight [n].
    None where hardly any point meets a plane."""
    motion = inverse(on_c2w) @ of_c2w
    turn = motion[:3, :3]
    there = of.points @ turn.T + motion[:3, 3]
    point = np.flatnonzero(there[:, 2] > NEAR_M)
    cell = view.at(project(there[point], seen))
    point, cell = point[cell >= 0], cell[cell >= 0]
    normal = on.normals[cell]
    off = there[point] - on.points[cell]
    residual = (normal * off).sum(1)
    facing = ((of.normals[point] @ turn.T) * normal).sum(1)
    good = (np.abs(residual) < 5 * kernel_m) & (facing > FACING) & ((off * off).sum(1) < OFF_M**2)
    if good.sum() < LEAST_SHARED:
        return None
    point, cell, normal, residual = point[good], cell[good], normal[good], residual[good]
    noise = NOISE_M + NOISE_PER_M * on.points[cell, 2] ** 2
    weight = (kernel_m**2 / (kernel_m**2 + residual**2)) ** 2 / noise**2
    out = normal @ on_c2w[:3, :3].T
    lever = there[point] @ on_c2w[:3, :3].T
    lever_of = lever + on_c2w[:3, 3] - of_c2w[:3, 3]
    by_camera = np.einsum("nc,nck->nk", normal @ turn, of.change[point])
    by_camera -= np.einsum("nc,nck->nk", normal, on.change[cell])
    jacobian = np.concatenate([out, np.cross(lever_of, out), -out, -np.cross(lever, out), by_camera], 1)
    return jacobian, residual, weight
