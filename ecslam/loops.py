"""Implicit loop closures: old keyframes near in space come back into the window (paper, section IV-C).

Nothing is matched or inserted: the joint optimisation over the window does the closing. This module says when.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .messages import LoopEvent
from .rigid import rotation_angle_deg
from .window import parallax


@dataclass(frozen=True)
class RevisitRule:
    """When a keyframe counts as seen again: near in place and direction, after at least ``away`` keyframes in a row
    that were not."""

    distance_m: float = 0.7
    angle_deg: float = 30.0
    away: int = 20


def revisited(
    keyframes: NDArray[np.float64], current: NDArray[np.float64], rule: RevisitRule = RevisitRule()
) -> NDArray[np.int64]:
    """Indices of the keyframes [K, 4, 4] (oldest first) that ``current`` [4, 4] sees again after having been away."""
    distance, angle = parallax(keyframes, current)
    near = (distance < rule.distance_m) & (angle < rule.angle_deg)
    far = np.flatnonzero(~near)
    run_start = np.flatnonzero(np.diff(far, prepend=-2) > 1)
    lengths = np.diff(np.append(run_start, len(far)))
    long = np.flatnonzero(lengths >= rule.away)
    if len(long) == 0:
        return np.empty(0, np.int64)
    last_gap = int(far[run_start[long[-1]]])
    return np.flatnonzero(near[:last_gap])


class LoopDetector:
    """Turns revisits into events: one when a revisit begins, none while it lasts."""

    def __init__(self, rule: RevisitRule = RevisitRule()) -> None:
        self._rule, self.inside = rule, False

    def update(self, keyframes: NDArray[np.float64], current: NDArray[np.float64]) -> NDArray[np.int64]:
        """The old keyframes of a revisit that begins now; empty otherwise."""
        old = revisited(keyframes, current, self._rule)
        begins = len(old) > 0 and not self.inside
        self.inside = len(old) > 0
        return old if begins else old[:0]


def loop_event(
    frame: int,
    keyframes: tuple[int, ...],
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    loss_before: float,
    loss_after: float,
    centres: NDArray[np.float32],
) -> LoopEvent:
    """What a closure did: the pose [4, 4] of ``frame`` before and after, the objective, and all camera centres [n, 3]
    before it. The errors against ground truth are for those who know it."""
    return LoopEvent(
        frame=frame,
        keyframes=keyframes,
        correction_cm=100 * float(np.linalg.norm(after[:3, 3] - before[:3, 3])),
        correction_deg=float(rotation_angle_deg(before, after)),
        loss_before=loss_before,
        loss_after=loss_after,
        error_before_cm=None,
        error_after_cm=None,
        rotation_error_before_deg=None,
        rotation_error_after_deg=None,
        trajectory_before=centres,
        c2w_before=before,
    )
