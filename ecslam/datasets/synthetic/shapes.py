"""What a room is made of: convex solids with paint, built from a few helpers and placed by rigid moves.

Solids live in a local frame centred on the solid; the world is in metres with z up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

BOX, ROUND, ELLIPSOID, FRUSTUM = 0, 1, 2, 3

Vec = tuple[float, float, float]


@dataclass(frozen=True)
class Paint:
    """How a solid looks.

    texture: a name that ``textures.texture`` takes. tint: linear RGB that multiplies it. repeat_m: metres per repeat of
    the texture, or 0 to stretch it once over each face. glow: emitted radiance (0 for everything but lamps, screens and
    windows). turn: swap the texture's axes. shift: texture offset in repeats.
    """

    texture: str = "plain"
    tint: Vec = (1.0, 1.0, 1.0)
    repeat_m: float = 1.0
    glow: float = 0.0
    turn: bool = False
    shift: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Shape:
    """A convex solid. half: half extents of its local bounding box, metres. rotation, center: local to world.

    extra: rounding radius of a ROUND box; slope dr/dz of a FRUSTUM (radius half[0] at its wide end); unused otherwise.
    """

    kind: int
    half: Vec
    paint: Paint
    center: NDArray[np.float64]
    rotation: NDArray[np.float64]
    extra: float = 0.0


@dataclass(frozen=True)
class Light:
    """An area light: points center + a half_u + b half_v (+ c half_w), |a|, |b|, |c| <= 1.

    normal: the side it shines to (a window), or zeros for all sides (a lamp). power: linear RGB; a surface facing the
    light one metre away receives this much. reach: the lit box [2, 3], usually the light's own room.
    """

    center: Vec
    half: tuple[Vec, Vec, Vec]
    normal: Vec
    power: Vec
    reach: tuple[Vec, Vec]


def block(low: Vec, high: Vec, paint: Paint, rounding: float = 0.0) -> Shape:
    """A box between two corners, with rounded edges when ``rounding`` (metres) is positive."""
    a, b = np.minimum(low, high), np.maximum(low, high)
    half = (b - a) / 2
    radius = min(rounding, float(half.min()))
    kind = ROUND if radius > 0 else BOX
    return Shape(kind, _vec(half), paint, (a + b) / 2, np.eye(3), radius)


def ball(center: Vec, radii: Vec, paint: Paint) -> Shape:
    """An ellipsoid with axes along x, y, z."""
    return Shape(ELLIPSOID, radii, paint, np.array(center, float), np.eye(3))


def can(base: Vec, bottom: float, top: float, height: float, paint: Paint) -> Shape:
    """A vertical cylinder or truncated cone: radius ``bottom`` at its base, ``top`` at its top."""
    wide = max(bottom, top)
    center = np.array([base[0], base[1], base[2] + height / 2])
    return Shape(FRUSTUM, (wide, wide, height / 2), paint, center, np.eye(3), (top - bottom) / height)


def rod(start: Vec, end: Vec, radius: float, paint: Paint) -> Shape:
    """A capsule between two points (its round ends reach ``radius`` beyond them)."""
    a, b = np.array(start, float), np.array(end, float)
    axis = b - a
    length = float(np.linalg.norm(axis))
    half = (radius, radius, length / 2 + radius)
    return Shape(ROUND, half, paint, (a + b) / 2, _frame_along(axis / length), radius)


def pillar(start: Vec, end: Vec, radius: float, paint: Paint) -> Shape:
    """A cylinder with flat ends between two points."""
    a, b = np.array(start, float), np.array(end, float)
    axis = b - a
    length = float(np.linalg.norm(axis))
    return Shape(FRUSTUM, (radius, radius, length / 2), paint, (a + b) / 2, _frame_along(axis / length))


def rotation_z(degrees: float) -> NDArray[np.float64]:
    """Rotation [3, 3] about the vertical."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def rotation_x(degrees: float) -> NDArray[np.float64]:
    """Rotation [3, 3] about the x axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def place(shapes: Iterable[Shape], x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> list[Shape]:
    """Turn shapes about the world's vertical by ``yaw`` degrees, then move them."""
    turn = rotation_z(yaw)
    offset = np.array([x, y, z])
    return [replace(s, center=turn @ s.center + offset, rotation=turn @ s.rotation) for s in shapes]


def tilt(shape: Shape, pitch: float, yaw: float = 0.0) -> Shape:
    """Turn one shape about its own centre: ``pitch`` degrees about x, then ``yaw`` about z."""
    return replace(shape, rotation=rotation_z(yaw) @ rotation_x(pitch) @ shape.rotation)


def _frame_along(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], 1)


def _vec(values: NDArray[np.float64]) -> Vec:
    return float(values[0]), float(values[1]), float(values[2])
