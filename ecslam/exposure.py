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
WITHIN = np.array([0.03, 0.01], np.float32)  # metres, and share of the depth: what two views measure of one surface
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
    to_view, lens = to_views(c2w, keyframe_poses[keyframes]), cell_lens(camera, cell)
    ratios = np.empty(len(keyframes) * near.size, np.float32)
    found = earlier_views.ratios(near, light_of(frame), lens, to_view, seen, lights, WITHIN, EVERY, SPARSE, ratios)
    if found < LEAST_PAIRS:
        return None
    middle = (found - 1) // 2, found // 2
    median = np.partition(ratios[:found], middle)[list(middle)].mean()
    return min(max(float(np.exp(median)), 1 / MOST), MOST)
