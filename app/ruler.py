"""Measuring on a mesh: where a ray meets it, and how far two points are apart. Pure numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ecslam.types import Mesh

Array = NDArray[np.float64]

TOLD_M = 0.02
LIFT_M, RING_M, RING_CORNERS = 0.012, 0.04, 12


@dataclass(frozen=True)
class Hit:
    """Where a ray meets a mesh. point: [3] metres; normal: unit [3], out of the surface."""

    point: Array
    normal: Array

    @property
    def lifted(self) -> Array:
        """[3] just off the surface, so that what is drawn there is not half inside it."""
        return self.point + LIFT_M * self.normal

    def ring(self) -> Array:
        """A small circle on the surface, as segments [RING_CORNERS, 2, 3]."""
        right, ahead = _across(self.normal)
        angles = np.linspace(0, 2 * np.pi, RING_CORNERS + 1)[:, None]
        corners = self.lifted + RING_M * (np.cos(angles) * right + np.sin(angles) * ahead)
        return np.stack([corners[:-1], corners[1:]], 1)


@dataclass(frozen=True)
class Measurement:
    """Two points on a mesh. up: unit [3], or None where nothing says which way is up."""

    start: Hit
    end: Hit
    up: Array | None

    @property
    def distance(self) -> float:
        """Metres."""
        return float(np.linalg.norm(self.end.point - self.start.point))

    @property
    def height(self) -> float | None:
        """The vertical part in metres; None without ``up``."""
        return None if self.up is None else abs(float((self.end.point - self.start.point) @ self.up))

    @property
    def width(self) -> float | None:
        """The horizontal part in metres; None without ``up``."""
        return None if self.height is None else float(np.sqrt(max(self.distance**2 - self.height**2, 0.0)))

    @property
    def slants(self) -> bool:
        """Whether both parts are worth telling."""
        return self.width is not None and self.height is not None and min(self.width, self.height) > TOLD_M

    def legs(self) -> list[list[Array]]:
        """Both parts as two segments [2, 3], which meet below the upper end; none without a slant."""
        if self.up is None or not self.slants:
            return []
        rise = (self.end.lifted - self.start.lifted) @ self.up * self.up
        corner = self.end.lifted - rise if rise @ self.up > 0 else self.start.lifted + rise
        return [[self.start.lifted, corner], [corner, self.end.lifted]]


def first_hit(mesh: Mesh, origin: Array, direction: Array) -> Hit | None:
    """Where a ray from ``origin`` [3] along ``direction`` [3] first meets a mesh's front, or None.

    Faces seen from behind are no obstacle, as the page does not draw them either.
    """
    direction = direction / np.linalg.norm(direction)
    # Seen along the ray, which then is the origin of the plane: x to the right, y down, depth.
    x, y, depth = np.stack([*_across(direction), direction]) @ (mesh.vertices - origin).T
    sides = np.packbits([x > 0, x < 0, y > 0, y < 0], axis=0)[0]
    a, b, c = sides[mesh.faces.T]
    near = np.flatnonzero((a & b & c) == 0)  # on no axis are all three corners on one side
    corners = mesh.faces[near]
    u, v = x[corners], y[corners]
    # Twice the areas that the ray spans with the edges: none is positive inside a triangle turned towards the viewer.
    share = np.stack([u[:, i] * v[:, j] - v[:, i] * u[:, j] for i, j in ((1, 2), (2, 0), (0, 1))], 1)
    total = share.sum(1)
    inside = (share <= 0).all(1) & (total < 0)
    corners, share = corners[inside], share[inside] / total[inside, None]
    distance = (share * depth[corners]).sum(1)
    ahead = distance > 0
    if not ahead.any():
        return None
    nearest = int(np.argmin(np.where(ahead, distance, np.inf)))
    p, q, r = mesh.vertices[corners[nearest]].astype(float)
    normal = np.cross(q - p, r - p)
    return Hit(origin + distance[nearest] * direction, normal / np.linalg.norm(normal))


def _across(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors [3] that make a right-handed frame with the unit ``axis`` [3] as their third."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def in_words(m: Measurement) -> str:
    """The distance, and below it both its parts where each can be told from nothing."""
    if m.width is None or m.height is None or not m.slants:
        return metres(m.distance)
    return f"{metres(m.distance)}\n↔ {metres(m.width)}  ↕ {metres(m.height)}"


def metres(value: float) -> str:
    """A length for people: 83.4 cm, 2.43 m."""
    return f"{100 * value:.1f} cm" if value < 0.9995 else f"{value:.2f} m"
