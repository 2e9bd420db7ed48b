"""What the camera measured in the first frame, as a mesh to look at until the map has learnt it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import Frame, Intrinsics, Mesh

COLUMNS = 160
JUMP = 0.08  # of the depth: neighbours that lie farther apart are not joined


def depth_mesh(frame: Frame, camera: Intrinsics, c2w: NDArray[np.float64], near_m: float, far_m: float) -> Mesh:
    """The surface that a frame sees from c2w [4, 4], about ``COLUMNS`` vertices wide, its front towards the camera.

    Depth outside near..far counts as none; the mesh is torn where depth jumps.
    """
    step = max(1, frame.depth.shape[1] // COLUMNS)
    depth, color = frame.depth[::step, ::step], frame.color[::step, ::step]
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] * step
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(depth.shape)], -1)
    points = (local * depth[..., None]) @ c2w[:3, :3].T + c2w[:3, 3]
    index = np.arange(depth.size).reshape(depth.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
    corners = depth.ravel()[faces]
    nearest, farthest = corners.min(1), corners.max(1)
    faces = faces[(nearest > near_m) & (farthest < far_m) & (farthest - nearest < JUMP * nearest)]
    used, rows = np.unique(faces, return_inverse=True)
    return Mesh(
        points.reshape(-1, 3)[used].astype(np.float32),
        rows.reshape(-1, 3).astype(np.int32),
        np.ascontiguousarray(color.reshape(-1, 3)[used]),
    )
