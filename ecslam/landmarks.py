"""Measured points that are known again by how they look: ORB descriptors (Rublee et al., ICCV 2011), matched and turned
into poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import Config
from .pixels import in_range
from .rigid import best_motion, inverse
from .types import Frame, Intrinsics

LANDMARK_BYTES = 44
KEPT, SOUGHT = 200, 500  # landmarks of a keyframe, and of a frame that is to be found
CORNERS, CELLS = 1000, 10  # found, and then spread over so many cells a side
PYRAMID, PATCH_PX = (1.4, 4), 31
ALIKE_BITS = 64  # of 256: descriptors farther apart show different things
TRIPLES, REFINEMENTS = 300, 3
NEAR_M, NEAR_PER_M = 0.02, 0.005  # two measurements of one point at a depth of z are within a + b z^2
LOOSELY = 2  # so many times as far apart, since alignment and drift move a pose away from what its landmarks say
TELLING = 100  # so many landmarks that know no other are somewhere else
LEAST_AGREED, MOST_TRIED, MOST_FOUND = 10, 5, 2  # matches that make a pose; views that are tried, poses that are kept


@dataclass(frozen=True, slots=True)
class Landmarks:
    """points: float32 [N, 3] metres, camera coordinates. descriptors: uint8 [N, 32]."""

    points: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)


def find_landmarks(frame: Frame, camera: Intrinsics, config: Config, count: int) -> Landmarks:
    """The strongest corners with measured depth, ``count`` at most, spread over the image."""
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    orb = cv2.ORB.create(CORNERS, *PYRAMID, PATCH_PX // 2 + 1, patchSize=PATCH_PX)
    corners = orb.detect(gray, None)
    place, depth = _measured(corners, frame, config)
    cell = (place * CELLS // frame.depth.shape[::-1]) @ (1, CELLS)
    strength = np.array([corner.response for corner in corners])
    chosen = _spread(strength, cell, depth > 0, count)
    corners, descriptors = orb.compute(gray, [corners[i] for i in chosen])
    if descriptors is None:
        return Landmarks(np.empty((0, 3), np.float32), np.empty((0, 32), np.uint8))
    place, depth = _measured(corners, frame, config)
    direction = (place - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return Landmarks(
        np.column_stack([direction * depth[:, None], depth]).astype(np.float32), np.asarray(descriptors, np.uint8)
    )


def _measured(
    corners: Sequence[cv2.KeyPoint], frame: Frame, config: Config
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Where corners lie, [N, 2] pixels, and the depth [N] there, 0 where there is none to be used."""
    place = np.array([corner.pt for corner in corners], np.float64).reshape(-1, 2)
    column, row = np.rint(place).astype(np.int64).T
    return place, in_range(frame.depth[row, column], config)


def _spread(
    strength: NDArray[np.float64], cell: NDArray[np.float64], usable: NDArray[np.bool_], count: int
) -> NDArray[np.int64]:
    """Indices of ``count`` usable ones at most: the strongest of every cell before the second of any."""
    order = np.flatnonzero(usable)
    order = order[np.lexsort((-strength[order], cell[order]))]
    first = np.searchsorted(cell[order], cell[order])
    return order[np.lexsort((-strength[order], np.arange(len(order)) - first))[:count]]


class Recognition:
    """Where landmarks may have been seen from. poses: camera-to-world [k, 4, 4], the likeliest first, each in agreement
    with one other view; none where too little agrees. strange: many landmarks, and no pose."""

    def __init__(
        self, seen: Landmarks, views: Sequence[Landmarks], poses: NDArray[np.float64], rng: np.random.Generator
    ) -> None:
        """views: landmarks of other frames, with their poses [V, 4, 4]."""
        matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        pairs = [_pairs(matcher, seen, view) for view in views]
        most = sorted(range(len(views)), key=lambda i: -len(pairs[i]))[:MOST_TRIED]
        self._telling = len(seen) >= TELLING
        self._pairs = [(seen.points[pairs[i][:, 0]], views[i].points[pairs[i][:, 1]], poses[i]) for i in most]
        found = [(*agreed_motion(here, there, rng), pose) for here, there, pose in self._pairs]
        found = sorted((one for one in found if one[1] >= LEAST_AGREED), key=lambda one: -one[1])
        self.poses = np.array([pose @ motion for motion, _, pose in found[:MOST_FOUND]]).reshape(-1, 4, 4)
        self.strange = self._telling and len(self.poses) == 0

    def allows(self, c2w: NDArray[np.float64]) -> bool:
        """Whether enough agrees at c2w [4, 4], or there is too little that could."""
        return not self._telling or any(
            (_off(inverse(pose) @ c2w, here, there) < LOOSELY * _near(here)).sum() >= LEAST_AGREED
            for here, there, pose in self._pairs
        )


def _pairs(matcher: cv2.BFMatcher, seen: Landmarks, view: Landmarks) -> NDArray[np.int64]:
    """Rows [M, 2] of ``seen`` and ``view`` whose descriptors are nearest to each other, both ways."""
    found = matcher.match(seen.descriptors, view.descriptors) if len(seen) and len(view) else ()
    return np.array([(m.queryIdx, m.trainIdx) for m in found if m.distance < ALIKE_BITS], np.int64).reshape(-1, 2)


def agreed_motion(
    source: NDArray[np.float32], target: NDArray[np.float32], rng: np.random.Generator
) -> tuple[NDArray[np.float64], int]:
    """The rigid motion [4, 4] that brings most points ``source`` [N, 3], in camera coordinates, onto ``target`` [N, 3],
    and how many (RANSAC over triples)."""
    if len(source) < LEAST_AGREED:
        return np.eye(4), 0
    near = _near(source)
    triples = rng.integers(0, len(source), (TRIPLES, 3))
    agrees = _off(best_motion(source[triples], target[triples]), source, target) < near
    motion, best = np.eye(4), agrees[agrees.sum(1).argmax()]
    for _ in range(REFINEMENTS):
        if best.sum() < LEAST_AGREED:
            return motion, 0
        motion = best_motion(source[best], target[best])
        best = _off(motion, source, target) < near
    return motion, int(best.sum())


def _near(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """How far apart [N] two measurements of points [N, 3] may be."""
    return NEAR_M + NEAR_PER_M * points[:, 2] ** 2


def _off(motion: NDArray[np.float64], source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float64]:
    """Distances [..., N] that are left of points after motions [..., 4, 4]."""
    moved = source @ np.swapaxes(motion[..., :3, :3], -1, -2) + motion[..., None, :3, 3]
    return np.asarray(np.linalg.norm(moved - target, axis=-1))
