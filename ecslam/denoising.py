"""Depth smoothed by as much as it is noisy, before anything else looks at it (ours).

A structured-light camera measures in steps of disparity, 2.6 cm apart at 3 m, and what is aligned to a surface fused
from them sticks to the steps. Inverse depth is affine over the image of a plane, so there the mean of two pixels that
lie opposite each other about a third is that one, at any slant; across an edge it is not, and these take no part.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .config import Config
from .kernels import denoise
from .types import Frame

REACH, COLUMNS = 2, 159  # of the differences that noise is estimated from: pixels, and about how many in a row
QUIET = 5e-5  # 1/m: half a millimetre at three metres; Replica and TUM store depth in steps of a third of that
WITHIN, MOST = 3.5, 0.012  # times the noise, and 1/m: a Kinect's


def denoised(frame: Frame, config: Config) -> Frame:
    """The frame with its depth as the configuration wants it, whichever way it is."""
    if config.denoise == (frame.measured is not None):
        return frame
    if frame.measured is not None:
        return replace(frame, depth=frame.measured, relief=None, measured=None)
    return replace(frame, depth=smoothed(frame.depth), relief=None, measured=frame.depth)


def smoothed(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth [H, W] in metres, 0 where there is none, smoothed within its own noise; itself where that is ``QUIET``."""
    noise = inverse_noise(depth)
    if noise < QUIET:
        return depth
    out = np.empty(depth.shape, np.float32)
    denoise.smooth(np.ascontiguousarray(depth, np.float32), min(WITHIN * noise, MOST), out)
    return out


def inverse_noise(depth: NDArray[np.float32]) -> float:
    """About the standard deviation (1/m) that noise gives to second differences of inverse depth; 0 without depth.

    Of a row's and a column's the smaller one counts, so that edges and curved things hardly do; and the upper quartile
    of those, since depth in steps has many that are 0.
    """
    rows, columns = (max(side - 2 * REACH, 0) for side in depth.shape)
    stride = max(columns // COLUMNS, 1)

    def seen(v: int, u: int) -> NDArray[np.float32]:
        return np.float32(1) / depth[REACH + v :, REACH + u :][:rows:stride, :columns:stride]

    with np.errstate(divide="ignore", invalid="ignore"):
        twice = 2 * seen(0, 0)
        along, down = (np.abs(seen(v, u) + seen(-v, -u) - twice) for v, u in ((0, REACH), (REACH, 0)))
    least = np.fmin(along, down)
    least = least[np.isfinite(least)]
    return float(np.quantile(least, 0.75)) if len(least) else 0.0
