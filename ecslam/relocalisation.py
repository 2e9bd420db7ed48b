"""Where a frame was seen from that tracking does not explain: recognised by its landmarks, or found by its shapes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from .align import Surface
from .config import Config
from .keyframes import Keyframe, make_thumbnail, most_similar
from .landmarks import SOUGHT, Recognition, find_landmarks
from .pixels import Pixels, spread_pixels
from .recovery import best
from .se3 import retract
from .tracker import LEAST_POINTS, TrackResult, track_direct
from .trajectory import Trajectory
from .types import Frame, Intrinsics

MOST_COMPARED, SEARCH_FROM = 150, 5  # keyframes, those that look most alike
SEARCH_POINTS, SEARCH_POSES, SEARCH_KEPT, SEARCH_FOUND, SEARCH_ROUNDS = 300, 600, 30, 3, 5
SEARCH_M, SEARCH_RAD = 0.2, 0.25
KERNELS_M, ITERATIONS = (0.2, 0.06, 0.02), 20


@dataclass
class Relocalisation:
    """``Elsewhere`` for the frame after ``trajectory``. rng: for pixels."""

    frame: Frame
    camera: Intrinsics
    surface: Surface
    trajectory: Trajectory
    keyframes: list[Keyframe]
    config: Config
    rng: np.random.Generator

    def recognised(self) -> TrackResult | None:
        """See ``Elsewhere``."""
        return self._aligned(self._recognition.poses)

    def searched(self) -> TrackResult | None:
        """See ``Elsewhere``. Sought around the last pose and the keyframes that look most alike, unless many landmarks
        know no other."""
        points = self._measured.points()
        if len(points) < LEAST_POINTS or self._recognition.strange:
            return None
        alike = self.trajectory.keyframe_poses()[self._alike[:SEARCH_FROM]]
        starts = np.concatenate([self.trajectory[-1][None], alike, self._recognition.poses])
        found = search(self.surface, points, starts, self.config.truncation_m, self._own_rng())
        return self._aligned(np.concatenate([starts, found]))

    def agrees(self, c2w: NDArray[np.float64]) -> bool:
        """See ``Elsewhere``."""
        return self._recognition.allows(c2w)

    def _aligned(self, starts: NDArray[np.float64]) -> TrackResult | None:
        """Direct alignment with a wide basin from ``starts`` [S, 4, 4]."""
        if len(starts) == 0 or len(self._measured.points()) < LEAST_POINTS:
            return None
        wide = replace(self.config, align=replace(self.config.align, kernels_m=KERNELS_M, iterations=ITERATIONS))
        gain = self.frame.gain
        return best(track_direct(self.surface, self._measured, start, wide, gain) for start in starts)

    @cached_property
    def _measured(self) -> Pixels:
        return spread_pixels(self.frame, self.camera, self.config.align.points, self.config, self.rng)

    @cached_property
    def _alike(self) -> list[int]:
        return most_similar(self.keyframes, make_thumbnail(self.frame.color), MOST_COMPARED)

    @cached_property
    def _recognition(self) -> Recognition:
        seen = find_landmarks(self.frame, self.camera, self.config, SOUGHT)
        views = [self.keyframes[i].landmarks for i in self._alike]
        return Recognition(seen, views, self.trajectory.keyframe_poses()[self._alike], self._own_rng())

    def _own_rng(self) -> np.random.Generator:
        return np.random.default_rng([self.config.seed, self.frame.index])


def search(
    surface: Surface,
    points: NDArray[np.float32],
    starts: NDArray[np.float64],
    truncation_m: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """The few poses [k, 4, 4] around ``starts`` [S, 4, 4] that bring measured points [N, 3], in camera coordinates,
    nearest to the known surface: random ones, then nearer and nearer around the best (the cross-entropy method)."""
    points = points[:: max(1, len(points) // SEARCH_POINTS)]
    best = starts[np.arange(SEARCH_POSES) % len(starts)]
    spread = np.array([SEARCH_M] * 3 + [SEARCH_RAD] * 3)
    for _ in range(SEARCH_ROUNDS):
        moves = torch.from_numpy(rng.normal(size=(len(best), 6)) * spread)
        poses = np.concatenate([best, retract(torch.from_numpy(best), moves).numpy()])
        ranked = poses[np.argsort(-_nearness(surface, points, poses, truncation_m), kind="stable")]
        best = ranked[np.arange(SEARCH_POSES) % SEARCH_KEPT]
        spread = spread / 2
    return ranked[:SEARCH_FOUND]


def _nearness(
    surface: Surface, points: NDArray[np.float32], poses: NDArray[np.float64], truncation_m: float
) -> NDArray[np.float64]:
    """[P] mean over the points of 1 on the surface, falling to 0 at ``truncation_m`` and where nothing is known."""
    world = np.einsum("pij,nj->pni", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    distance, known = surface.distances(world.reshape(-1, 3))
    near = np.where(known, np.maximum(0.0, 1 - np.abs(distance) / truncation_m), 0.0)
    return np.asarray(near.reshape(len(poses), -1).mean(1))
