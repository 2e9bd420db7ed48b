"""What a camera sees of a few planes: exact depth, and a smooth texture fixed in the world."""

from dataclasses import replace

import cv2
import numpy as np
import torch

from ecslam import se3
from ecslam.types import Frame, Intrinsics

CAMERA = Intrinsics(160.0, 160.0, 79.5, 59.5, 160, 120)
TINY_CAMERA = Intrinsics(48.0, 48.0, 23.6, 17.3, 48, 36)


def look(c2w, planes, camera=CAMERA):
    """What a camera at c2w [4, 4] sees of planes (n, d) with n . x = d."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    direction = rays @ c2w[:3, :3].T
    depth = np.full(direction.shape[:2], np.inf)
    for n, d in planes:
        with np.errstate(divide="ignore"):
            t = (d - c2w[:3, 3] @ n) / (direction @ n)
        depth = np.where((t > 0) & (t < depth), t, depth)
    hit = np.isfinite(depth)
    point = c2w[:3, 3] + direction * np.where(hit, depth, 0)[..., None]
    light = 0.5 + 0.25 * (np.sin(9 * point[..., 0]) + np.cos(8 * point[..., 1] + 3 * point[..., 2]))
    color = np.repeat((255 * light).round().astype(np.uint8)[..., None], 3, -1)
    return Frame(0, 0.0, color, np.where(hit, depth, 0).astype(np.float32))


def look_row_by_row(c2w, sweep, planes, camera=CAMERA):
    """What a rolling shutter sees that moves by ``sweep`` [6], in its own coordinates, from the first row to the last
    and is at c2w [4, 4] halfway."""
    rows = []
    for v in range(camera.height):
        motion = np.eye(4)
        share = (v + 0.5) / camera.height - 0.5
        motion[:3, :3] = cv2.Rodrigues(share * sweep[3:])[0]
        motion[:3, 3] = share * sweep[:3]
        rows.append(look(c2w @ motion, planes, replace(camera, cy=camera.cy - v, height=1)))
    return replace(
        rows[0], color=np.concatenate([r.color for r in rows]), depth=np.concatenate([r.depth for r in rows])
    )


def corner():
    """Three walls."""
    return [(np.array([0, 0, 1.0]), 2.0), (np.array([0, 1.0, 0]), 0.7), (np.array([1.0, 0, 0]), 0.9)]


def pose(rotation_deg=(0, 0, 0), centre=(0, 0, 0)):
    """c2w [4, 4] of a rotation vector and a centre."""
    xi = torch.tensor([*centre, *np.radians(rotation_deg)], dtype=torch.float64)
    return se3.retract(torch.eye(4, dtype=torch.float64), xi).numpy()


def noisy_corner(c2w, camera):
    """The corner with noise, holes, an edge in depth and colours."""
    seen, rng = look(c2w, corner(), camera), np.random.default_rng(0)
    depth = seen.depth + rng.normal(0, 0.004, seen.depth.shape).astype(np.float32)
    depth[rng.random(depth.shape) < 0.05] = 0
    depth[20:, 30:] -= 0.4 * (depth[20:, 30:] > 0)
    return replace(seen, depth=depth, color=rng.integers(0, 256, seen.color.shape, np.uint8))


POSES = (  # from which no voxel is seen exactly on the border between two pixels
    pose((0.3, -0.2, 0.1), (0.013, 0.007, 0.003)),
    pose((0.4, 6.0, 2.0), (-0.011, 0.002, 0.017)),
    pose((4.0, -5.0, 0.3), (0.021, 0.012, 0.001)),
)
SWEEP = np.array([0.03, -0.02, 0.04, 0.02, -0.03, 0.01])
