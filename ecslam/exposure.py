"""The camera's exposure changes by itself; luminance is brought to what it was at first, so that it goes on telling
tracking where the camera is (ours). Colours, which the map blends, are left as they come.

A surface that an earlier keyframe saw tells by how much: the median ratio over what both see.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .earlier import Views, cell_lens, cell_px, light_of, relief_of, to_views
from .kernels import earlier_views
from .types import Frame, Intrinsics

EVERY, SPARSE = 2, 2  # each which of the views that are asked, and each which of the frame's rows and columns of cells
WITHIN_M, WITHIN_PER_M = 0.03, 0.01  # of each other, what two views measured of one surface
LEAST_PAIRS = 60
NOTICED = 0.01  # smaller changes are left alone
MOST = 8.0  # times brighter or darker than at first; more is a mistake


def as_at_first(
    frame: Frame,
    camera: Intrinsics,
    c2w: NDArray[np.float64],
    earlier: Views,
    keyframe_poses: NDArray[np.float64],
    before: float,
) -> Frame:
    """The frame, seen from about c2w [4, 4], with the ``gain`` that brings its luminance to what ``earlier`` views saw.
    That is ``before``, the gain of the frame before, where there is hardly any difference, or too little was seen of
    it. keyframe_poses: [K, 4, 4] of all keyframes."""
    now = _gain(frame, camera, c2w, earlier, keyframe_poses)
    return replace(frame, gain=before if now is None or abs(now / before - 1) < NOTICED else now)


def _gain(
    frame: Frame, camera: Intrinsics, c2w: NDArray[np.float64], earlier: Views, keyframe_poses: NDArray[np.float64]
) -> float | None:
    seen, lights, keyframes = earlier
    if not keyframes:
        return None
    near, cell = relief_of(frame), cell_px(frame.depth.shape[1])
    to_view = to_views(c2w, keyframe_poses[keyframes])
    lens, within = (np.array(n, np.float32) for n in (cell_lens(camera, cell), (WITHIN_M, WITHIN_PER_M)))
    ratios = np.empty(len(keyframes) * near.size, np.float32)
    found = earlier_views.ratios(near, light_of(frame), lens, to_view, seen, lights, within, EVERY, SPARSE, ratios)
    if found < LEAST_PAIRS:
        return None
    return float(np.exp(np.median(ratios[:found])).clip(1 / MOST, MOST))
