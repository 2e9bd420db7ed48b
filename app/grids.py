"""Grids with a line every half metre: on the floor for all viewers, and behind a wall for one that looks straight at
it."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from . import theme
from .geometry import standing

CELL_M, SECTION_M, SIZE_M = 0.5, 2.0, 24.0
GAP_M = 0.02  # between a grid and what lies on it

Array = NDArray[np.float64]


def add_grid(scene: viser.SceneApi, name: str, dark: bool = False) -> viser.GridHandle:
    """A grid in the x-y plane, seen from +z."""
    return scene.add_grid(
        name,
        SIZE_M,
        SIZE_M,
        cell_size=CELL_M,
        section_size=SECTION_M,
        cell_color=theme.GRID[dark],
        section_color=theme.GRID[dark],
        cell_thickness=0.8,
        section_thickness=1.2,
        fade_distance=22,
        shadow_opacity=0.0,
    )


def paint(grid: viser.GridHandle, dark: bool) -> None:
    """Colour a grid for a dark or a light page."""
    grid.cell_color = grid.section_color = theme.GRID[dark]


class WallGrids:
    """The grids of the viewers that look straight at a wall. Only the hub's thread calls these methods."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._dark = server, False
        self._grids: dict[int, viser.GridHandle] = {}

    def put_up(self, client: viser.ClientHandle, floor: Array, up: Array, side: Array, depth: float) -> None:
        """Show one viewer a grid that faces ``side`` [3], ``depth`` metres away from the floor's middle [3], one of its
        lines level with the floor."""
        self.take_down(client)
        self._forget_who_left()
        grid = add_grid(client.scene, "/wall", self._dark)
        grid.wxyz, grid.position = standing(up, side), floor - (depth + GAP_M) * side
        self._grids[client.client_id] = grid

    def take_down(self, client: viser.ClientHandle) -> None:
        """Take one viewer's grid away."""
        grid = self._grids.pop(client.client_id, None)
        if grid is not None:
            grid.remove()

    def set_dark(self, dark: bool) -> None:
        """Draw all of them, and those to come, for a dark or a light page."""
        self._dark = dark
        self._forget_who_left()
        for grid in self._grids.values():
            paint(grid, dark)

    def _forget_who_left(self) -> None:
        self._grids = {number: self._grids[number] for number in self._grids.keys() & self._server.get_clients()}
