"""Lost and found: notice within a few frames that the map no longer explains the images, and when it does again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from .se3 import retract
from .tracker import TrackResult

LOST_FIT = 0.25
LOST_SHARE, FOUND_SHARE = 0.6, 0.92  # of the usual fit: a wrong place can be made to explain 85 % of it
DOUBT_SHARE, DOUBT_FIT = 0.9, 0.8  # a frame tracked well has over 96 % of it; before there is a usual one, the latter
USUAL_OVER = 10
FOUND_FIT = 0.6
PATIENCE = 3
MAX_STEP_M = 0.5
MAX_TURN_DEG = 35.0
SUDDEN_M, SUDDEN_DEG = 0.1, 6.0  # since the frame before: so far, alignment often ends in a wrong place
AROUND_M, AROUND_RAD = 0.1, 0.1


class Elsewhere(Protocol):
    """Where else a frame may have been seen from, worked out when it is asked for."""

    def recognised(self) -> TrackResult | None:
        """From a place that looks the same; None where none does."""
        ...

    def searched(self) -> TrackResult | None:
        """From where the shapes fit; None where there is no use in looking for it."""
        ...

    def agrees(self, c2w: NDArray[np.float64]) -> bool:
        """Whether what the frame looks like allows it to have been seen from c2w [4, 4]."""
        ...


class Recovery:
    """Judges every tracked pose. ``missed``: this frame's was not trusted, so it has that of the frame before.
    ``lost``: several in a row were missed; no mapping until a place is recognised again."""

    def __init__(self) -> None:
        self.lost, self.missed, self.note = False, False, ""
        self.misses = 0
        self.usual_fit = 0.0

    def judge(
        self, track: TrackResult, last: NDArray[np.float64], elsewhere: Elsewhere, gap: bool = False
    ) -> TrackResult:
        """The result to use for this frame, given the previous pose [4, 4]. ``elsewhere`` is asked only in need, which
        is also when the map explains the frame worse than is usual, and after a ``gap`` in time, a miss or a sudden
        motion: it may have ended in a wrong place nearby. What then counts against it alone is that looks disagree, for
        a sudden motion only where the fit is worse, too."""
        self.note = ""
        worse = track.fit < (DOUBT_SHARE * self.usual_fit or DOUBT_FIT)
        sudden = not near(track.c2w, last, SUDDEN_M, SUDDEN_DEG)
        adrift = gap or self.misses > 0 or (sudden and worse)
        trusted = not self.lost and self._plausible(track, last) and not (adrift and not elsewhere.agrees(track.c2w))
        doubted = not trusted or worse
        if doubted or sudden or adrift:
            least = max(FOUND_FIT, FOUND_SHARE * self.usual_fit, track.fit if trusted else 0.0)
            tried = (way() for way in (elsewhere.recognised, elsewhere.searched)[: 1 + doubted])
            found = next((r for r in tried if r is not None and r.fit >= least and elsewhere.agrees(r.c2w)), None)
            if found is not None:
                self.note = "relocalised" if self.lost else "recovered" if doubted else ""
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
        return near(track.c2w, last, MAX_STEP_M, MAX_TURN_DEG)

    def state(self) -> NDArray[np.float64]:
        """Three numbers, for a checkpoint."""
        return np.array([self.lost, self.misses, self.usual_fit])

    def load(self, state: NDArray[np.float64]) -> None:
        """Go on from what ``state`` gave."""
        lost, misses, usual_fit = state
        self.lost, self.misses, self.usual_fit = bool(lost), int(misses), float(usual_fit)


def near(a: NDArray[np.float64], b: NDArray[np.float64], metres: float, degrees: float) -> bool:
    """Whether two poses [4, 4] are less than this apart."""
    cosine = 0.5 * (np.vdot(a[:3, :3], b[:3, :3]) - 1)
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < metres and cosine > np.cos(np.radians(degrees)))


def around(c2w: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The pose [4, 4] and those a step or a turn away along each axis: where to look for a camera after a gap."""
    steps = np.concatenate([np.zeros((1, 6)), np.diag([AROUND_M] * 3 + [AROUND_RAD] * 3)])
    moves = torch.from_numpy(np.concatenate([steps, -steps[1:]]))
    return list(retract(torch.from_numpy(c2w).expand(len(moves), 4, 4), moves).numpy())


def best(results: Iterable[TrackResult]) -> TrackResult:
    """The one of several results that the map explains best."""
    return max(results, key=lambda result: result.fit)
