"""Lost and found: notice within a few frames that the map no longer explains the images, and find the way back."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from .align import Surface
from .config import Config
from .pixels import Pixels
from .se3 import retract, rotation_angle_deg
from .tracker import TrackResult, track_direct

LOST_FIT = 0.25
LOST_SHARE, FOUND_SHARE = 0.6, 0.92  # of the usual fit: a wrong place can be made to explain 85 % of it
DOUBT_SHARE, DOUBT_FIT = 0.9, 0.8  # a frame tracked well has over 96 % of it; before there is a usual one, the latter
USUAL_OVER = 10
FOUND_FIT = 0.6
PATIENCE = 3
MAX_STEP_M = 0.5
MAX_TURN_DEG = 35.0
SEARCH_POINTS, SEARCH_POSES, SEARCH_KEPT, SEARCH_FOUND, SEARCH_ROUNDS = 300, 600, 30, 3, 5
SEARCH_M, SEARCH_RAD = 0.2, 0.25
AROUND_M, AROUND_RAD = 0.1, 0.1
RELOCALISE_KERNELS_M, RELOCALISE_ITERATIONS = (0.2, 0.06, 0.02), 20


class Recovery:
    """Judges every tracked pose. ``missed``: this frame's was not trusted, so it has that of the frame before.
    ``lost``: several in a row were missed; no mapping until a place is recognised again."""

    def __init__(self) -> None:
        self.lost, self.missed, self.note = False, False, ""
        self.misses = 0
        self.usual_fit = 0.0

    def judge(
        self, track: TrackResult, last: NDArray[np.float64], relocalise: Callable[[], TrackResult | None]
    ) -> TrackResult:
        """The result to use for this frame, given the previous pose [4, 4]; ``relocalise`` is asked only in need, and
        when the map explains the frame worse than is usual: a fast motion may have ended in a wrong place nearby."""
        self.note = ""
        trusted = not self.lost and self._plausible(track, last)
        if not trusted or track.fit < (DOUBT_SHARE * self.usual_fit or DOUBT_FIT):
            found, known = relocalise(), track.fit if trusted else 0.0
            if found is not None and found.fit >= max(FOUND_FIT, FOUND_SHARE * self.usual_fit, known):
                self.note = "relocalised" if self.lost else "recovered"
                track, trusted = found, True
        if trusted:
            self.usual_fit += (track.fit - self.usual_fit) / USUAL_OVER if self.usual_fit else track.fit
            self.lost, self.missed, self.misses = False, False, 0
            return track
        self.misses += 1
        self.missed = True
        self.lost = self.lost or self.misses >= PATIENCE
        self.note = "lost: the map does not explain this frame" if self.lost else "not tracked, pose held"
        return replace(track, c2w=last)

    def _plausible(self, track: TrackResult, last: NDArray[np.float64]) -> bool:
        if not np.isfinite(track.c2w).all() or track.fit < max(LOST_FIT, LOST_SHARE * self.usual_fit):
            return False
        step = float(np.linalg.norm(track.c2w[:3, 3] - last[:3, 3]))
        return step < MAX_STEP_M and float(rotation_angle_deg(last, track.c2w)) < MAX_TURN_DEG

    def state(self) -> NDArray[np.float64]:
        """Three numbers, for a checkpoint."""
        return np.array([self.lost, self.misses, self.usual_fit])

    def load(self, state: NDArray[np.float64]) -> None:
        """Go on from what ``state`` gave."""
        lost, misses, usual_fit = state
        self.lost, self.misses, self.usual_fit = bool(lost), int(misses), float(usual_fit)


def around(c2w: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The pose [4, 4] and those a step or a turn away along each axis: where to look for a camera after a gap."""
    steps = np.concatenate([np.zeros((1, 6)), np.diag([AROUND_M] * 3 + [AROUND_RAD] * 3)])
    moves = torch.from_numpy(np.concatenate([steps, -steps[1:]]))
    return list(retract(torch.from_numpy(c2w).expand(len(moves), 4, 4), moves).numpy())


def best_start(
    track: Callable[[NDArray[np.float64]], TrackResult], starts: Iterable[NDArray[np.float64]]
) -> TrackResult:
    """Track from every start pose [4, 4] and keep the result that the map explains best."""
    return max((track(start) for start in starts), key=lambda result: result.fit)


def relocalise(
    surface: Surface, measured: Pixels, starts: NDArray[np.float64], config: Config, rng: np.random.Generator
) -> TrackResult:
    """Direct alignment with a wide basin from ``starts`` [S, 4, 4] and the poses that a search around these finds."""
    align = replace(config.align, kernels_m=RELOCALISE_KERNELS_M, iterations=RELOCALISE_ITERATIONS)
    found = search(surface, measured.points(), starts, config.truncation_m, rng)
    wide = replace(config, align=align)
    return best_start(lambda start: track_direct(surface, measured, start, wide), [*starts, *found])


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
