"""Rolling shutter: a camera that is read row by row moves on meanwhile, so each row is seen from a place of its own.

A pose is that of the moment when the middle row was read; what other rows measured is moved to where it lies as seen
from there. The motion is taken from the poses themselves, as odometry with a LiDAR does (KISS-ICP, Vizzo et al. 2023).
Ours, not the paper's.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .pixels import Pixels
from .rigid import inverse
from .types import Intrinsics

Sweep = NDArray[np.float64]
STILL: Sweep = np.zeros(6)
FAR_M = 1e3  # what is taken for the distance of pixels without depth


def sweep_between(before: NDArray[np.float64], after: NDArray[np.float64], seconds: float, camera: Intrinsics) -> Sweep:
    """How the camera moves from its first row to its last if it takes ``seconds`` from pose ``before`` [4, 4] to
    ``after``: translation in metres and rotation vector [6], in its own coordinates. Zeros where it has no such shutter
    or no time passes; no more than the whole motion."""
    if camera.readout_s <= 0 or seconds <= 0:
        return STILL
    motion = inverse(before) @ after
    turn = cv2.Rodrigues(motion[:3, :3])[0].ravel()
    return np.concatenate([motion[:3, 3], turn]) * min(camera.readout_s / seconds, 1.0)


def straight(points: NDArray[np.float32], camera: Intrinsics, sweep: Sweep) -> NDArray[np.float32]:
    """Camera points [N, 3] in metres, each as its row saw it, as seen halfway through the image."""
    if not sweep.any():
        return points
    share = (camera.fy * points[:, 1:2] / points[:, 2:] + camera.cy + 0.5) / camera.height - 0.5
    return halfway(points, share, sweep).astype(np.float32)


def halfway(points: NDArray[np.floating], share: NDArray[np.floating], sweep: Sweep) -> NDArray[np.float64]:
    """Camera points [N, 3], seen at a ``share`` [N, 1] of the sweep from -0.5 to 0.5, as seen at 0."""
    return np.asarray(points + share * (sweep[:3] + np.cross(sweep[3:], points)))


def straight_pixels(pixels: Pixels, camera: Intrinsics, sweep: Sweep) -> Pixels:
    """The same pixels, their rays and depths as seen halfway through the image."""
    if not sweep.any():
        return pixels
    there = pixels.depth > 0
    rays = np.concatenate([pixels.direction, np.ones((len(pixels), 1), np.float32)], 1)
    points = straight(rays * np.where(there, pixels.depth, np.float32(FAR_M))[:, None], camera, sweep)
    z = points[:, 2]
    return replace(pixels, direction=points[:, :2] / z[:, None], depth=np.where(there, z, np.float32(0)))
