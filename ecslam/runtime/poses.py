"""Trajectories as text: TUM and KITTI."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def tum_text(timestamps: NDArray[np.float64], c2w: NDArray[np.float64]) -> str:
    """TUM format, a line a pose: timestamp (s) tx ty tz (m) qx qy qz qw, from [N] and [N, 4, 4]."""
    if not len(c2w):
        return ""
    quaternions = Rotation.from_matrix(c2w[:, :3, :3]).as_quat(canonical=True)
    rows = zip(timestamps, c2w[:, :3, 3], quaternions, strict=True)
    return "".join(f"{time:.6f} " + " ".join(f"{v:.9f}" for v in (*t, *q)) + "\n" for time, t, q in rows)


def kitti_text(c2w: NDArray[np.float64]) -> str:
    """KITTI format, a line a pose: the upper 3x4 of [N, 4, 4], row by row."""
    return "".join(" ".join(f"{v:.9e}" for v in pose[:3].reshape(-1)) + "\n" for pose in c2w)
