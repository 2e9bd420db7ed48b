"""Rigid motions as 4x4 camera-to-world matrices, in numpy: for what runs without torch. Tangents are in ``se3``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def inverse(c2w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of rigid 4x4 matrices [..., 4, 4]."""
    rotation = np.swapaxes(c2w[..., :3, :3], -1, -2)
    out = np.zeros_like(c2w)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -(rotation @ c2w[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1
    return out


def orthonormalise(c2w: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest rigid motion to [..., 4, 4] (removes the drift of repeated products)."""
    u, _, vt = np.linalg.svd(c2w[..., :3, :3])
    sign = np.ones(u.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(u @ vt))
    out = c2w.copy()
    out[..., :3, :3] = (u * sign[..., None, :]) @ vt
    return out


def polished(c2w: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest rigid motion to [..., 4, 4] that products and their rounding have taken off by a millionth at most:
    one step of Newton's iteration, a fraction of what ``orthonormalise`` takes."""
    out, r = c2w.copy(), c2w[..., :3, :3]
    out[..., :3, :3] = 1.5 * r - 0.5 * (r @ (np.swapaxes(r, -1, -2) @ r))
    return out


def is_rigid(c2w: NDArray[np.float64]) -> bool:
    """Whether an array is a 4x4 matrix of a rigid motion, to about a hundredth."""
    if c2w.shape != (4, 4) or not np.isfinite(c2w).all():
        return False
    return bool(np.abs(orthonormalise(c2w) - c2w).max() < 1e-2 and np.allclose(c2w[3], [0, 0, 0, 1]))


def best_motion(source: NDArray[np.floating], target: NDArray[np.floating]) -> NDArray[np.float64]:
    """The motions [..., 4, 4] that bring points [..., N, 3] closest to others in least squares; N >= 1."""
    middle, goal = source.mean(-2), target.mean(-2)
    motion = np.zeros((*source.shape[:-2], 4, 4))
    motion[..., :3, :3] = np.swapaxes(target - goal[..., None, :], -1, -2) @ (source - middle[..., None, :])
    motion = orthonormalise(motion)
    motion[..., :3, 3] = goal - (motion[..., :3, :3] @ middle[..., None])[..., 0]
    motion[..., 3, 3] = 1
    return motion


def rotation_angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle in degrees between the rotations of poses [..., 4, 4]."""
    r = np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3]
    axis = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1)
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    return np.degrees(np.arctan2(0.5 * np.linalg.norm(axis, axis=-1), 0.5 * (trace - 1)))


def quaternions(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions [N, 4], x y z w with w >= 0, of rotation matrices [N, 3, 3]."""
    r = rotation
    x, y, z = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    # Of the four rows, each the quaternion times four times one of its parts, the longest loses no digits.
    rows = np.empty((len(r), 4, 4))
    rows[:, 0, 0], rows[:, 1, 1], rows[:, 2, 2] = 1 + x - y - z, 1 - x + y - z, 1 - x - y + z
    rows[:, 3, 3] = 1 + x + y + z
    for i, j in ((0, 1), (0, 2), (1, 2)):
        rows[:, i, j] = rows[:, j, i] = r[:, i, j] + r[:, j, i]
        k = 3 - i - j
        rows[:, k, 3] = rows[:, 3, k] = (r[:, j, i] - r[:, i, j]) * (-1 if k == 1 else 1)
    length = np.linalg.norm(rows, axis=2)
    best = np.take_along_axis(rows, length.argmax(1)[:, None, None], 1)[:, 0]
    return best / np.linalg.norm(best, axis=1, keepdims=True) * np.where(best[:, 3:] < 0, -1.0, 1.0)


def rotations(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4], x y z w, of any length but zero."""
    q = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    v, w = q[:, :3], q[:, 3]
    outer = 2 * v[:, :, None] * v[:, None, :]
    cross = np.zeros_like(outer)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[:, j, i], cross[:, i, j] = 2 * w * v[:, k], -2 * w * v[:, k]
    return outer + cross + (1 - 2 * (v * v).sum(1))[:, None, None] * np.eye(3)
