"""Where the camera really was, as far as that is known, and how far from it a run is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..evaluation.trajectory import Spread, absolute_error
from ..messages import LoopEvent
from ..rigid import rotation_angle_deg
from .tally import Tally


class Truth:
    """poses: [N, 4, 4] of a sequence's frames, not finite where unknown; None where all are. ate_cm: of the run, when
    it was last measured; None before that and without truth."""

    def __init__(self, poses: NDArray[np.float64] | None) -> None:
        self.poses = poses if poses is not None and np.isfinite(poses).all((1, 2)).any() else None
        self.ate_cm: Spread | None = None

    def measure(self, poses: NDArray[np.float64], tally: Tally) -> None:
        """Bring the ATE up to date with the estimated poses [n, 4, 4]."""
        error = None if self.poses is None else absolute_error(poses, self.poses[tally.rows])
        self.ate_cm = error.cm if error else None

    def in_map(self, tally: Tally) -> NDArray[np.float64] | None:
        """True poses [N, 4, 4] in the world of the map; None where the first processed frame (or that at work) has
        none, as the map then lies in a world of its own."""
        first = tally.rows[0] if tally.rows else max(tally.position - 1, 0)
        return self.poses if self.poses is not None and np.isfinite(self.poses[first]).all() else None

    def unknown(self, tally: Tally) -> int | None:
        """How many processed frames have no usable true pose and so no part in the ATE; None without ground truth."""
        return None if self.poses is None else int((~np.isfinite(self.poses[tally.rows]).all((1, 2))).sum())

    def with_errors(self, loop: LoopEvent, after: NDArray[np.float64], tally: Tally) -> LoopEvent:
        """The loop with the errors of its frame's pose before it and after, c2w [4, 4], where the truth is known."""
        known, before = self.in_map(tally), loop.c2w_before
        if known is None or before is None or not np.isfinite(known[loop.frame]).all():
            return loop
        truth = known[loop.frame]
        return replace(
            loop,
            error_before_cm=100 * float(np.linalg.norm(before[:3, 3] - truth[:3, 3])),
            error_after_cm=100 * float(np.linalg.norm(after[:3, 3] - truth[:3, 3])),
            rotation_error_before_deg=float(rotation_angle_deg(before, truth)),
            rotation_error_after_deg=float(rotation_angle_deg(after, truth)),
        )
