"""Sparse marching cubes with vertex colours: memory and time grow with the observed surface, not with the scene box."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .meshing_blocks import EDGE, Lattice, ObservedBlocks
from .meshing_table import CORNERS, EDGE_AXIS, EDGE_CORNER, TRIANGLES
from .types import Mesh

__all__ = ["MeshingStopped", "ObservedBlocks", "extract_mesh", "voxel_for_budget"]

SdfFunction = Callable[[NDArray[np.float32]], NDArray[np.floating]]
ColorFunction = Callable[[NDArray[np.float32]], NDArray[np.uint8]]

_POINTS_PER_CALL = 1 << 17
_BLOCKS_PER_STEP = 2048
_POINTS = EDGE**3


class MeshingStopped(Exception):
    """``should_stop`` answered True while a mesh was being made."""


def extract_mesh(
    sdf: SdfFunction,
    color: ColorFunction | None,
    observed: ObservedBlocks,
    voxel_m: float,
    *,
    progress: Callable[[float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Mesh:
    """Extract the zero level of a field where it was observed (Lorensen and Cline 1987, tables of our own).

    sdf: float32 [N, 3] metres -> [N], in units of the truncation distance, negative inside; called with at most
    131,072 points at a time, each lattice point once. A cell with a non-finite corner yields no surface.
    color: float32 [N, 3] -> uint8 [N, 3], called at the vertices. observed: a cell is left out when its middle lies
    outside. voxel_m: lattice spacing; the lattice has a point at the world's origin, so the same surface gives the same
    triangles whatever else was observed. progress: gets the share done in 0..1.

    Returns faces that are counter-clockwise seen from free space, watertight wherever all was observed.
    Raises MeshingStopped soon after should_stop answers True.
    """

    def report(done: float) -> None:
        if should_stop is not None and should_stop():
            raise MeshingStopped
        if progress is not None:
            progress(done)

    report(0.0)
    lattice = Lattice.covering(observed, voxel_m)
    values = _evaluate(sdf, lattice, report)
    edges = _triangles(lattice, values)
    unique, faces = np.unique(edges, return_inverse=True)
    vertices = _vertices(lattice, values, unique)
    colors = None if color is None else _in_batches(color, vertices, np.empty((len(vertices), 3), np.uint8))
    report(1.0)
    return Mesh(vertices, faces.reshape(-1, 3).astype(np.int32), colors)


def voxel_for_budget(voxel_m: float, triangles: int, max_triangles: int) -> float:
    """The voxel size at which a surface with ``triangles`` at ``voxel_m`` has about ``max_triangles`` (0 = no limit).

    The number of triangles of a surface falls with the square of the voxel size; 5 % are kept in reserve.
    """
    if max_triangles <= 0 or triangles <= max_triangles:
        return voxel_m
    return voxel_m * float(np.sqrt(1.05 * triangles / max_triangles))


def _evaluate(sdf: SdfFunction, lattice: Lattice, report: Callable[[float], None]) -> NDArray[np.float32]:
    """[n + 1, EDGE, EDGE, EDGE]: the field at the corners of observed cells, NaN elsewhere and in the last row."""
    values = np.full((len(lattice.keys) + 1) * _POINTS, np.nan, np.float32)
    corners = lattice.corners()
    for start in range(0, len(corners), _POINTS_PER_CALL):
        part = corners[start : start + _POINTS_PER_CALL]
        values[part] = sdf(lattice.points(part))
        report(0.9 * (start + len(part)) / len(corners))
    return values.reshape(-1, EDGE, EDGE, EDGE)


def _triangles(lattice: Lattice, values: NDArray[np.float32]) -> NDArray[np.int64]:
    """Lattice edges [3 F] cut by the corners of all triangles, as (flat point number of the lower end) * 3 + axis."""
    parts = [np.zeros(0, np.int64)]
    for start in range(0, len(lattice.keys), _BLOCKS_PER_STEP):
        rows = np.arange(start, min(start + _BLOCKS_PER_STEP, len(lattice.keys)))
        halo = lattice.with_halo(values, rows)
        inside = halo < 0
        case = np.zeros((len(rows), EDGE, EDGE, EDGE), np.uint8)
        for c, (x, y, z) in enumerate(CORNERS):
            case |= inside[:, x : x + EDGE, y : y + EDGE, z : z + EDGE].view(np.uint8) << np.uint8(c)
        cut = lattice.cells[rows] & (case > 0) & (case < 255)
        cell = np.stack(np.nonzero(cut), -1)  # [n, 4]
        corner = cell[:, None, 1:] + CORNERS
        known = np.isfinite(halo[cell[:, :1], corner[..., 0], corner[..., 1], corner[..., 2]]).all(1)
        edges = TRIANGLES[case[cut][known]]
        which, slot = np.nonzero(edges >= 0)
        edge = edges[which, slot]
        parts.append(_edge_keys(lattice, rows[0], cell[known][which], edge))
    return np.concatenate(parts)


def _edge_keys(lattice: Lattice, first_row: int, cell: NDArray[np.int64], edge: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keys [n] of edges ``edge`` [n] of the cells [n, 4] (block, i, j, k), the same from every cell around the edge."""
    point = cell[:, 1:] + CORNERS[EDGE_CORNER[edge]]
    owner = lattice.upper[first_row + cell[:, 0], (point // EDGE) @ (1, 2, 4)]
    local = np.ravel_multi_index(tuple((point % EDGE).T), (EDGE, EDGE, EDGE))
    return (owner * _POINTS + local) * 3 + EDGE_AXIS[edge]


def _vertices(lattice: Lattice, values: NDArray[np.float32], edges: NDArray[np.int64]) -> NDArray[np.float32]:
    """Zero crossings [n, 3] on lattice edges [n] by linear interpolation."""
    low, axis = np.divmod(edges, 3)
    row, point = np.divmod(low, _POINTS)
    stride = EDGE ** (2 - axis)
    last = point // stride % EDGE == EDGE - 1
    high = np.where(last, lattice.upper[row, 1 << axis] * _POINTS + point - (EDGE - 1) * stride, low + stride)
    a, b = values.reshape(-1)[low].astype(np.float64), values.reshape(-1)[high].astype(np.float64)
    share = np.clip(a / (a - b), 1e-3, 1 - 1e-3)  # a vertex never falls onto another one: no face without area
    vertices = lattice.points(low)
    vertices[np.arange(len(edges)), axis] += (share * lattice.voxel_m).astype(np.float32)
    return vertices


def _in_batches(function: ColorFunction, points: NDArray[np.float32], out: NDArray[np.uint8]) -> NDArray[np.uint8]:
    for start in range(0, len(points), _POINTS_PER_CALL):
        part = slice(start, start + _POINTS_PER_CALL)
        out[part] = function(points[part])
    return out
