"""A step of Adam for rigid poses, jitted: what ``reference.pose_step`` does with some forty small tensors."""

from __future__ import annotations

import numpy as np
from numba import njit

from ._cpu_math import INNER, OUTER

SMALL = 1e-8  # squared angle below which Rodrigues' factors are taken from their series


@njit(**OUTER)
def pose_worker(c2w, d_c2w, mean, square, rates, about, decays, epsilon, count, moved):
    """See ``reference.pose_step``; about: [P, 3], or [0, 3] for none; the poses go into ``moved``."""
    gradient, move, turn = np.empty(6), np.empty(6), np.empty((3, 3))
    first, second = 1 - decays[0] ** count, 1 - decays[1] ** count
    for p in range(c2w.shape[0]):
        tangent_gradient(c2w[p], d_c2w[p], about, p, gradient)
        for i in range(6):
            mean[p, i] = decays[0] * mean[p, i] + (1 - decays[0]) * gradient[i]
            square[p, i] = decays[1] * square[p, i] + (1 - decays[1]) * gradient[i] * gradient[i]
            move[i] = -rates[p, i] * (mean[p, i] / first) / (np.sqrt(square[p, i] / second) + epsilon)
        rotation(move[3], move[4], move[5], turn)
        for i in range(3):
            shift = c2w[p, i, 3] + move[i]
            for j in range(3):
                turned = turn[i, 0] * c2w[p, 0, j] + turn[i, 1] * c2w[p, 1, j] + turn[i, 2] * c2w[p, 2, j]
                moved[p, i, j] = turned
                if about.shape[0]:
                    shift += (c2w[p, i, j] - turned) * about[p, j]
            moved[p, i, 3] = shift
        moved[p, 3] = c2w[p, 3]


@njit(**INNER)
def tangent_gradient(pose, d_pose, about, p, out):
    """See ``se3.tangent_gradient``: [6] into ``out``."""
    for i in range(3):
        after, last = (i + 1) % 3, (i + 2) % 3
        out[i], out[3 + i] = d_pose[i, 3], 0.0
        for k in range(3):
            out[3 + i] += d_pose[last, k] * pose[after, k] - d_pose[after, k] * pose[last, k]
            if about.shape[0]:
                out[3 + i] += about[p, k] * (pose[last, k] * d_pose[after, 3] - pose[after, k] * d_pose[last, 3])


@njit(**INNER)
def rotation(x, y, z, out):
    """See ``se3.so3_exp``: [3, 3] into ``out``."""
    angle_square = x * x + y * y + z * z
    angle = np.sqrt(angle_square)
    a, b = 1 - angle_square / 6, 0.5 - angle_square / 24
    if angle_square >= SMALL:
        a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle_square
    rest = 1 - b * angle_square
    out[0, 0], out[0, 1], out[0, 2] = rest + b * x * x, b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, rest + b * y * y, b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, rest + b * z * z
