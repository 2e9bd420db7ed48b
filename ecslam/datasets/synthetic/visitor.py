"""Somebody who walks through the picture again and again: what a room at rest never shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...types import Intrinsics

EVERY, HALF = 120, 45  # frames from one visit to the next, and before and after its middle
AHEAD_M, STEP_M = 1.4, 0.025  # in front of the camera in the middle of a visit, and sideways from frame to frame
SHOULDER_M, HEAD_M = 1.35, 1.58
BODY_RADIUS_M, HEAD_RADIUS_M = 0.22, 0.12
STRIPE_M = 0.08
SKIN, CLOTHES = (205, 160, 130), ((150, 60, 50), (60, 70, 110))

Floats = NDArray[np.float64]


def standing(index: int, path: Floats, floor_m: float) -> Floats | None:
    """Where the visitor's feet are in frame ``index``, [3] metres; None between two visits. path: [N, 4, 4], the poses
    of a camera that goes round and round."""
    since = index % EVERY - EVERY // 2
    if abs(since) > HALF:
        return None
    middle = path[(index - since) % len(path)]
    ahead = middle[:2, 2] / np.linalg.norm(middle[:2, 2])
    place = middle[:2, 3] + AHEAD_M * ahead + STEP_M * since * np.array([ahead[1], -ahead[0]])
    return np.array([*place, floor_m])


def with_visitor(
    color: NDArray[np.uint8], depth: NDArray[np.float32], camera: Intrinsics, c2w: Floats, feet: Floats
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour [H, W, 3] and depth [H, W] of a room, seen from c2w [4, 4], with the visitor before what is behind."""
    v, u = np.indices(depth.shape)
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(depth.shape)], -1)
    ray = ray @ c2w[:3, :3].T
    head, shoulder = (feet + np.array([0, 0, height]) for height in (HEAD_M, SHOULDER_M))
    parts = (
        _ball(ray, c2w[:3, 3] - head, HEAD_RADIUS_M),
        _ball(ray, c2w[:3, 3] - shoulder, BODY_RADIUS_M),
        _column(ray, c2w[:3, 3] - feet, BODY_RADIUS_M, SHOULDER_M),
    )
    near = np.min(parts, 0)
    seen = (near > 0) & (near < np.where(depth > 0, depth, np.inf))
    place = c2w[:3, 3] + near[seen, None] * ray[seen]
    on_head = parts[0][seen] == near[seen]
    stripe = np.floor((place[:, 2] - feet[2]) / STRIPE_M).astype(int) % 2
    paint = np.where(on_head[:, None], SKIN, np.array(CLOTHES)[stripe])
    centre = np.where(on_head[:, None], head, np.column_stack([np.tile(feet[:2], (len(place), 1)), place[:, 2]]))
    outward = (place - centre) / np.linalg.norm(place - centre, axis=1, keepdims=True)
    bright = 0.75 + 0.25 * outward @ (0.6, 0.0, 0.8)
    color, depth = color.copy(), depth.copy()
    color[seen], depth[seen] = np.clip(paint * bright[:, None], 0, 255), near[seen]
    return color, depth


def _column(ray: Floats, start: Floats, radius_m: float, height_m: float) -> Floats:
    """See ``_ball``; of an upright cylinder that stands on the origin, without its top."""
    far = _ball(ray[..., :2], start[:2], radius_m)
    height = start[2] + np.where(np.isfinite(far), far, 0) * ray[..., 2]
    return np.where((height >= 0) & (height <= height_m), far, np.inf)


def _ball(ray: Floats, start: Floats, radius_m: float) -> Floats:
    """How far along rays [..., n] from ``start`` [n] a ball about the origin is met; infinity where it is not."""
    a, b, c = (ray**2).sum(-1), ray @ start, start @ start - radius_m**2
    under = b**2 - a * c
    met = (-b - np.sqrt(np.maximum(under, 0))) / a
    return np.where((under > 0) & (met > 0), met, np.inf)
