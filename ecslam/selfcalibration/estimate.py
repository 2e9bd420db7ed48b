"""From a recording to its camera: track it, take some of its views, adjust them and the camera together."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ..config import Config
from ..datasets import Prefetch
from ..datasets.calibration import calibration_of
from ..datasets.views import in_order
from ..denoising import denoised
from ..indices import evenly
from ..shutter import STILL, sweep_between
from ..slam import Slam
from ..types import Calibration, FrameError, InputError, Sequence
from .cells import PARAMETERS, Cells, cells_of, difference, moved
from .joint import ITERATIONS, USUAL, Verdict, adjust, verdict

VIEWS, LEAST_VIEWS, LEAST_CELLS = 60, 8, 100
EVERY = 5  # frames, at least, from one view to the next
MOST = 4.0  # times what is usual

Watch = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Found:
    """What ``views`` of a recording say of its camera. given, found: as it was said to be, and as it is. By parameter
    [5] (logarithm of the focal length, centre, radial, inverse depth): verdict; spread: how far apart two halves of the
    views would put it. apart_m: metres by which surfaces of different views miss each other with either."""

    given: Calibration
    found: Calibration
    verdict: Verdict
    spread: NDArray[np.float64]
    apart_m: tuple[float, float]
    views: int


def self_calibrate(sequence: Sequence, config: Config, watch: Watch) -> Found:
    """Focal length, centre of the image, radial bend and offset of inverse depth of a recording's camera.

    config: how to track it, on the CPU. watch: called with what is being done, and how many steps of how many are. A
    parameter without which the views would fit about as well stays as given. A bend adds to one that a calibration has
    put right already, to first order. Raises InputError where there is too little to tell.
    """
    given = Calibration(sequence.intrinsics)
    views, poses = _views(sequence, config, watch)
    if len(views) < LEAST_VIEWS:
        raise InputError(
            f"{sequence.name}: only {len(views)} of its views show enough flat surface to calibrate by; record some "
            "turns in a furnished room, one to three metres from its walls"
        )
    steps = count(1)
    adjusted = partial(adjust, given=given, watch=lambda: watch("adjusting", next(steps), 5 * ITERATIONS))
    as_given = adjusted(views, poses, given, free=np.zeros(PARAMETERS, bool))
    full = adjusted(views, as_given.poses, given, free=np.ones(PARAMETERS, bool))
    says = verdict(difference(full.calibration, given), full.spread)
    joint, spread = as_given, np.zeros(PARAMETERS)
    if says.wrong.any():
        start = moved(given, difference(full.calibration, given) * says.wrong)
        joint = adjusted(views, full.poses, start, free=says.wrong)
        halves = (adjusted(views[i::2], joint.poses[i::2], joint.calibration, free=says.wrong) for i in (0, 1))
        spread = np.abs(difference(*(half.calibration for half in halves)))
    change = difference(joint.calibration, given)
    if (np.abs(change) > MOST * USUAL).any():
        raise InputError(
            f"{sequence.name}: no likely camera explains its views; see with ecslam check that depth is in metres"
        )
    watch("adjusting", 1, 1)
    before = calibration_of(sequence)
    return Found(before, moved(before, change), says, spread, (as_given.apart_m, joint.apart_m), len(views))


def _views(sequence: Sequence, config: Config, watch: Watch) -> tuple[list[Cells], NDArray[np.float64]]:
    """Some views, as cells, and where they were seen from [V, 4, 4]."""
    without_map = replace(config.mapping, first_iterations=1, iterations=0)
    config = replace(config, schedule="strict", mapping=without_map)
    slam = Slam(config, sequence.intrinsics)
    usable = np.flatnonzero(in_order(sequence.timestamps()))
    wanted = set(usable[evenly(len(usable), min(VIEWS, max(len(usable) // EVERY, 1)))].tolist())
    found: list[tuple[int, Cells]] = []
    with closing(Prefetch(sequence, usable.tolist(), prepare=partial(denoised, config=config))) as frames:
        for index, frame in frames:
            if isinstance(frame, FrameError):
                continue
            try:
                report = slam.step(frame)
            except FrameError:
                continue
            if index in wanted and report.tracked and not report.lost:
                cells = cells_of(frame.depth, config.depth_far_m, STILL)
                if len(cells) >= LEAST_CELLS:
                    found.append((len(slam.trajectory) - 1, cells))
            watch("tracking", index + 1, len(sequence))
    poses, times = slam.trajectory.poses(), slam.trajectory.timestamps
    views = []
    for place, cells in found:
        before, after = max(place - 1, 0), min(place + 1, len(poses) - 1)
        sweep = sweep_between(poses[before], poses[after], times[after] - times[before], sequence.intrinsics)
        views.append(replace(cells, sweep=sweep))
    return views, poses[[place for place, _ in found]]
