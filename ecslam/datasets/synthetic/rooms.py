"""A furnished room: its shapes, lights and camera path. The rooms themselves are one file each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .path import Waypoint
from .shapes import Light, Shape, Vec


@dataclass(frozen=True)
class Room:
    """interior: float64 [2, 3] box around all surfaces that can be seen. frames: length of one round of the path."""

    shapes: tuple[Shape, ...]
    lights: tuple[Light, ...]
    interior: NDArray[np.float64]
    path: tuple[Waypoint, ...]
    frames: int


def lamp(center: Vec, power: float, reach: tuple[Vec, Vec], size: float = 0.12, warm: Vec = (1.0, 0.84, 0.62)) -> Light:
    """A lamp that shines to all sides; power: irradiance at one metre."""
    half = ((size, 0.0, 0.0), (0.0, size, 0.0), (0.0, 0.0, size))
    return Light(center, half, (0.0, 0.0, 0.0), (power * warm[0], power * warm[1], power * warm[2]), reach)


def daylight(center: Vec, inward: Vec, width: float, height: float, power: float, reach: tuple[Vec, Vec]) -> Light:
    """A window's light; ``inward`` is its axis-parallel normal into the room."""
    across: Vec = (abs(inward[1]) * width / 2, abs(inward[0]) * width / 2, 0.0)
    half = (across, (0.0, 0.0, height / 2), (0.0, 0.0, 0.0))
    return Light(center, half, inward, (0.92 * power, 0.97 * power, 1.06 * power), reach)


def box(low: Vec, high: Vec) -> tuple[Vec, Vec]:
    """A lit region, a little larger than a room's inner corners."""
    m = 0.08
    return (low[0] - m, low[1] - m, low[2] - m), (high[0] + m, high[1] + m, high[2] + m)
