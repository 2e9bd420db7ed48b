"""Two cameras side by side before a wall whose colour is known at every point in space."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ecslam.types import Intrinsics

DEPTH = Intrinsics(60.0, 62.0, 33.0, 22.0, 64, 48)
WIDE = Intrinsics(45.0, 46.0, 30.0, 25.0, 64, 48)


def motion(
    turn_deg: tuple[float, float, float] = (0, 0, 0), move: tuple[float, float, float] = (0, 0, 0)
) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    matrix[:3, 3] = move
    return matrix


def paint(points: np.ndarray) -> np.ndarray:
    """The colour of the world at points [..., 3]: it tells where they are."""
    return np.clip(np.rint(128 + 60 * points), 0, 255).astype(np.uint8)


def seen(camera: Intrinsics, pose: np.ndarray, wall_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [H, W, 3] of the wall z = wall_m where the pixels of a camera at ``pose`` look, and their depth [H, W]."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.matrix()).T
    directions = rays @ pose[:3, :3].T
    depth = (wall_m - pose[2, 3]) / directions[..., 2]
    return pose[:3, 3] + directions * depth[..., None], depth


def images(color: Intrinsics, depth_to_color: np.ndarray, wall_m: float) -> tuple[np.ndarray, np.ndarray]:
    """What the two cameras take of the wall; that of depth is where the world begins."""
    points, _ = seen(color, np.linalg.inv(depth_to_color), wall_m)
    return paint(points), seen(DEPTH, np.eye(4), wall_m)[1].astype(np.float32)
