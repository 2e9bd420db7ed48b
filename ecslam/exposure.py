"""The camera's exposure and white balance change by themselves; colours are brought to what they were at first (ours).

A surface that an earlier keyframe saw tells by how much: each channel's median ratio over what both see. The map then
has one brightness, and luminance goes on telling tracking where the camera is.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .earlier import Views, cell_lens, cell_px, relief_of, tint_of
from .kernels import earlier_views
from .keyframes import Prepared
from .rigid import inverse
from .types import Frame, Intrinsics

EVERY, SPARSE = 2, 2  # each which of the views that are asked, and each which of the frame's rows and columns of cells
WITHIN_M, WITHIN_PER_M = 0.03, 0.01  # of each other, what two views measured of one surface
LEAST_PAIRS = 60
NOTICED = 0.01  # smaller changes are left alone, so that a camera that has none keeps its colours as they are
MOST = 8.0  # times brighter or darker than at first; more is a mistake

Gains = NDArray[np.float32]
AS_AT_FIRST: Gains = np.ones(3, np.float32)


def gains(
    frame: Frame,
    camera: Intrinsics,
    c2w: NDArray[np.float64],
    earlier: Views,
    keyframe_poses: NDArray[np.float64],
    before: Gains,
) -> Gains:
    """By what the frame's red, green and blue [3] are to be multiplied, seen from about c2w [4, 4], to match what
    ``earlier`` views saw. ``before``, those of the frame before, where that is hardly any different, or too little was
    seen of it. keyframe_poses: [K, 4, 4] of all keyframes."""
    seen, tints, keyframes = earlier
    if not keyframes:
        return before
    near, cell = relief_of(frame), cell_px(frame.depth.shape[1])
    to_view = (inverse(keyframe_poses[keyframes]) @ c2w)[:, :3].astype(np.float32)
    lens, within = (np.array(n, np.float32) for n in (cell_lens(camera, cell), (WITHIN_M, WITHIN_PER_M)))
    ratios = np.empty((3, len(keyframes) * near.size), np.float32)
    found = earlier_views.ratios(near, tint_of(frame), lens, to_view, seen, tints, within, EVERY, SPARSE, ratios)
    if found < LEAST_PAIRS:
        return before
    now = np.exp(np.median(ratios[:, :found], 1)).clip(1 / MOST, MOST).astype(np.float32)
    return now if np.abs(now / before - 1).max() > NOTICED else before


def exposed(frame: Frame, factors: Gains) -> Frame:
    """The frame with its colours multiplied by ``factors`` [3], and the keyframe that was made of it; itself where that
    changes no colour."""
    values = np.arange(256, dtype=np.float32)
    table = np.rint(np.minimum(values[:, None] * factors, 255)).astype(np.uint8)
    if (table == values[:, None]).all():
        return frame
    keyframe = frame.keyframe
    if isinstance(keyframe, Prepared):
        keyframe = replace(keyframe, keyframe=keyframe.keyframe.recoloured(table))
    color = np.asarray(cv2.LUT(frame.color, table[None]), np.uint8)
    return replace(frame, color=color, tint=tint_of(frame) + np.log(factors), keyframe=keyframe)
