"""A hand-held camera path: a smooth closed curve through waypoints at an even pace, plus a little sway."""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

PACE_M, PACE_DEG = 0.017, 1.05
SWAY_M, SWAY_DEG = 0.005, 0.4
SETTLE_FRAMES = 6.0
SAMPLES = 8192


@dataclass(frozen=True)
class Waypoint:
    """x, y, z: camera centre in metres. yaw: degrees, 0 looks along +x and 90 along +y; it may pass 360, so that a turn
    keeps its sense. pitch: degrees, negative looks down."""

    x: float
    y: float
    z: float
    yaw: float
    pitch: float


def closed_path(waypoints: Many[Waypoint], frames: int, seed: int) -> NDArray[np.float64]:
    """Poses float64 [frames, 4, 4] camera-to-world on a closed, twice continuously differentiable path.

    After the last frame follows the first: the path and its sway have period ``frames``.
    """
    knots = np.array([(w.x, w.y, w.z, w.yaw, w.pitch, 0.0) for w in waypoints], np.float64)
    turns = np.array([0, 0, 0, 360 * np.round((knots[-1, 3] - knots[0, 3]) / 360), 0, 0])
    steps = np.diff(np.concatenate([knots, knots[:1] + turns]), axis=0)
    s = np.concatenate([[0], np.cumsum(_pace(steps))])
    s /= s[-1]
    wave = CubicSpline(s, np.concatenate([knots - s[:-1, None] * turns, knots[:1]]), bc_type="periodic")

    def curve(t: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(wave(t) + t[:, None] * turns)

    fine = np.linspace(0, 1, SAMPLES + 1)
    done = np.concatenate([[0], np.cumsum(_pace(np.diff(curve(fine), axis=0)))])
    share = np.arange(frames)[:, None] / frames
    even = curve(np.interp(share[:, 0] * done[-1], done, fine)) - share * turns
    calm = gaussian_filter1d(even, SETTLE_FRAMES, axis=0, mode="wrap") + share * turns
    return poses(calm + _sway(frames, seed))


def _pace(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """How long steps [N, 6] of position and angles feel, in frames."""
    return np.hypot(np.linalg.norm(steps[:, :3], axis=1) / PACE_M, np.linalg.norm(steps[:, 3:], axis=1) / PACE_DEG)


def poses(states: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera-to-world [N, 4, 4] from states [N, 6]: x, y, z in metres, yaw, pitch, roll in degrees."""
    yaw, pitch, roll = np.radians(states[:, 3:]).T
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], -1)
    level = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], -1)
    plumb = np.cross(forward, level)
    right = np.cos(roll)[:, None] * level + np.sin(roll)[:, None] * plumb
    out = np.tile(np.eye(4), (len(states), 1, 1))
    out[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
    out[:, :3, 3] = states[:, :3]
    return out


def _sway(frames: int, seed: int) -> NDArray[np.float64]:
    """[frames, 6] offsets (x, y, z, yaw, pitch, roll): sums of sines between about 0.2 and 1 Hz with whole periods."""
    rng = np.random.default_rng(seed)
    phase = np.arange(frames)[:, None] / frames
    out = np.zeros((frames, 6))
    for share in (0.006, 0.011, 0.019, 0.031):
        cycles = np.maximum(1, np.round(frames * share * rng.uniform(0.85, 1.15, 6)))
        out += np.sin(2 * np.pi * (phase * cycles + rng.random(6))) * (0.008 / (0.002 + share))
    return out / np.abs(out).max(0) * ([SWAY_M] * 3 + [SWAY_DEG] * 3)
