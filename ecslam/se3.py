"""Rigid motions as 4x4 camera-to-world matrices and their tangent vectors.

A tangent vector xi = (v, w) is [..., 6]: translation v in metres first, then rotation w in radians (axis times angle).
Updates are applied from the left, in the axes of the world: the rotation turns the camera about its optical centre, or
about a point that it looks at, and v then moves it.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .rigid import inverse, orthonormalise, polished, rotation_angle_deg

__all__ = [
    "inverse",
    "orthonormalise",
    "polished",
    "repeated",
    "retract",
    "rotation_angle_deg",
    "skew",
    "so3_exp",
    "so3_log",
    "tangent_gradient",
]


def skew(w: Tensor) -> Tensor:
    """[..., 3] -> [..., 3, 3] with skew(a) @ b = a x b."""
    zero = torch.zeros_like(w[..., 0])
    x, y, z = w.unbind(-1)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*w.shape[:-1], 3, 3)


def so3_exp(w: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of axis-angle vectors [..., 3] (Rodrigues; smooth at zero)."""
    square = (w * w).sum(-1)[..., None, None]
    small = square < 1e-8
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    a = torch.where(small, 1 - square / 6, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / safe)
    k = skew(w)
    return torch.eye(3, dtype=w.dtype, device=w.device) + a * k + b * (k @ k)


def so3_log(rotation: Tensor) -> Tensor:
    """Axis-angle vectors [..., 3] of rotation matrices [..., 3, 3]; angles in [0, pi]."""
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    vee = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        -1,
    )
    sine = 0.5 * vee.norm(dim=-1)
    angle = torch.atan2(sine, 0.5 * (trace - 1))
    scale = torch.where(sine > 1e-6, angle / (2 * sine.clamp_min(1e-30)), torch.full_like(sine, 0.5))
    near_pi = (sine <= 1e-6) & (trace < 0)
    outer = 0.5 * (rotation + torch.eye(3, dtype=rotation.dtype, device=rotation.device))
    column = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    axis = torch.take_along_dim(outer, column[..., None, None].expand(*outer.shape[:-1], 1), -1)[..., 0]
    axis = axis / axis.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return torch.where(near_pi[..., None], angle[..., None] * axis, scale[..., None] * vee)


def retract(c2w: Tensor, xi: Tensor, about: Tensor | None = None) -> Tensor:
    """Move poses [..., 4, 4] by tangent vectors [..., 6]: R <- exp(w) R, t <- t + v.

    about: [..., 3], in camera coordinates, the points that the rotations leave where they are; without: the camera.
    """
    rotation = so3_exp(xi[..., 3:]) @ c2w[..., :3, :3]
    translation = c2w[..., :3, 3] + xi[..., :3]
    if about is not None:
        translation = translation + ((c2w[..., :3, :3] - rotation) @ about[..., None])[..., 0]
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = c2w[..., 3:, :].expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def repeated(motion: NDArray[np.float64], times: float) -> NDArray[np.float64]:
    """A small rigid motion [4, 4] so many times over, which may be a fraction: rotation and translation apart."""
    turn = so3_log(torch.from_numpy(motion[:3, :3]))
    out = motion.copy()
    out[:3, :3] = so3_exp(times * turn).numpy()
    out[:3, 3] = times * motion[:3, 3]
    return out


def tangent_gradient(c2w: Tensor, gradient: Tensor, about: Tensor | None = None) -> Tensor:
    """Gradient [..., 6] in the tangent of ``retract`` at zero, from one [..., 3, 4] with respect to c2w[:3, :4]."""
    rotation, g, v = c2w[..., :3, :3], gradient[..., :3, :3], gradient[..., :3, 3]
    m = g @ rotation.transpose(-1, -2)
    w = torch.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
    if about is not None:
        w = w - torch.linalg.cross((rotation @ about[..., None])[..., 0], v)
    return torch.cat([v, w], -1)
