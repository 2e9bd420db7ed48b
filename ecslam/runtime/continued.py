"""Whether a run that goes on has the recording that it was begun with."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets.calibration import ERRORS, calibration_of
from ..types import InputError, Sequence
from .runfolder import CAMERA
from .tally import Tally

SAME = 1e-6


def camera_of(sequence: Sequence) -> dict[str, float]:
    """What ``run.json`` tells of the camera."""
    calibration = calibration_of(sequence)
    errors = {name: getattr(calibration, name) for name in ERRORS}
    return {name: getattr(sequence.intrinsics, name) for name in CAMERA} | errors


def require_same_camera(address: str, sequence: Sequence, about: dict[str, Any]) -> None:
    """Raises InputError when the sequence at ``address`` is not the one that ``about``, of ``run.json``, tells of."""
    for name, here in camera_of(sequence).items():
        was = about.get(name, 0)
        if not abs(was - here) < SAME:
            raise InputError(
                f"{address}: not the sequence that this run was begun with ({name} was {was:g} and is "
                f"{here:g}); give that one with --sequence"
            )


def require_same_times(address: str, sequence: Sequence, tally: Tally, known: NDArray[np.float64]) -> None:
    """Raises InputError when the frames that are done are not those of the sequence at ``address``. known: [n] seconds
    of the processed ones."""
    times, rows = sequence.timestamps(), np.array(tally.rows, np.int64)
    if len(times) < tally.position or (len(rows) and np.abs(times[rows] - known).max() > SAME):
        raise InputError(
            f"{address}: its frames are no longer those that this run has done ({tally.position} of "
            f"them; there are {len(times)} now); put them back or start again with ecslam run"
        )
