"""What a structured-light camera adds: disparity noise and steps, jitter at edges, holes, grain in the colour.

The figures follow Khoshelham and Oude Elberink, "Accuracy and Resolution of Kinect Depth Data", Sensors 2012 (noise in
disparity, so that the axial error grows with the square of the depth), and Nguyen, Izadi and Lovell, "Modeling Kinect
Sensor Noise for Improved 3D Reconstruction and Tracking", 3DIMPVT 2012 (lateral noise of about 0.8 pixels).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...types import Intrinsics

BASELINE_FOCAL = 0.075 * 580.0  # metres times pixels, Kinect v1
DISPARITY_STEP = 1 / 8
DISPARITY_SIGMA = 0.06
LATERAL_SIGMA = 0.8 / 640  # of the image width
NEAR_M, FAR_M = 0.35, 8.0
GRAZING_COSINE = 0.14
EDGE_JUMP = 0.04
EDGE_LOSS = 0.5
COLOR_SIGMA = 2.0


def kinect(
    color: NDArray[np.uint8], depth: NDArray[np.float32], camera: Intrinsics, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour uint8 [H, W, 3] and depth float32 [H, W] as such a camera would report them; 0 where it sees no depth."""
    noisy = color + COLOR_SIGMA * rng.standard_normal(color.shape, np.float32)
    lost = _lost(depth, camera, rng)
    disparity = BASELINE_FOCAL / np.maximum(_jitter(depth, rng), 1e-3)
    disparity += DISPARITY_SIGMA * rng.standard_normal(depth.shape, np.float32)
    disparity = np.maximum(np.rint(disparity / DISPARITY_STEP), 1) * DISPARITY_STEP
    measured = (BASELINE_FOCAL / disparity).astype(np.float32)
    measured[lost | (measured < NEAR_M) | (measured > FAR_M)] = 0
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), measured


def _jitter(depth: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Each pixel takes the depth of one about LATERAL_SIGMA away."""
    height, width = depth.shape
    shift = np.rint(LATERAL_SIGMA * width * rng.standard_normal((2, height, width), np.float32)).astype(np.int64)
    rows = np.clip(np.arange(height)[:, None] + shift[0], 0, height - 1)
    columns = np.clip(np.arange(width) + shift[1], 0, width - 1)
    return depth[rows, columns]


def _lost(depth: NDArray[np.float32], camera: Intrinsics, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Pixels without depth: grazing surfaces, nothing there, and half of those next to a jump in depth."""
    safe = np.maximum(depth, 1e-3)
    du, dv = np.gradient(np.log(safe), axis=1), np.gradient(np.log(safe), axis=0)
    jump = np.maximum(np.abs(du), np.abs(dv)) > EDGE_JUMP / 2
    u = (np.arange(camera.width, dtype=np.float32) - np.float32(camera.cx)) / np.float32(camera.fx)
    v = ((np.arange(camera.height, dtype=np.float32) - np.float32(camera.cy)) / np.float32(camera.fy))[:, None]
    gu, gv = du * np.float32(camera.fx), dv * np.float32(camera.fy)
    along = 1 + u * gu + v * gv  # -n . (u, v, 1) for the normal n = (gu, gv, -(1 + u gu + v gv))
    cosine = 1 / np.sqrt((gu * gu + gv * gv + along * along) * (1 + u * u + v * v))
    torn = jump & (rng.random(depth.shape, np.float32) < EDGE_LOSS)
    return np.asarray((depth <= 0) | torn | (~jump & (cosine < GRAZING_COSINE)))
