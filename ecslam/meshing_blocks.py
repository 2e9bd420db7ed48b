"""Sparse sets of blocks: where the surface was observed, and the lattice blocks that marching cubes visits."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .meshing_table import CORNERS

EDGE = 8
"""Lattice points along one edge of a block."""

_POINTS_AT_ONCE = 1 << 17
_BITS = 21
_HALF = 1 << (_BITS - 1)
_ORIGIN = (_HALF << 2 * _BITS) + (_HALF << _BITS) + _HALF


def pack(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """int64 keys [...] of integer block coordinates [..., 3], each in -2^20 .. 2^20 - 1."""
    return (index[..., 0] << 2 * _BITS) + (index[..., 1] << _BITS) + index[..., 2] + _ORIGIN


def shift(step: NDArray[np.int64]) -> NDArray[np.int64]:
    """What to add to a key to go ``step`` [..., 3] blocks further."""
    return pack(step) - _ORIGIN


def unpack(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Integer block coordinates [..., 3] of keys [...]."""
    mask = (1 << _BITS) - 1
    return np.stack([keys >> 2 * _BITS, keys >> _BITS & mask, keys & mask], -1) - _HALF


def find(keys: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of ``wanted`` in the sorted ``keys`` [n], or n where it is missing."""
    if not len(keys):
        return np.zeros(wanted.shape, np.int64)
    rows = np.searchsorted(keys, wanted)
    return np.where(keys[np.minimum(rows, len(keys) - 1)] == wanted, rows, len(keys))


@dataclass(frozen=True)
class ObservedBlocks:
    """Where a surface has been seen: cubes with edge ``block_m`` metres, as sorted unique int64 keys.

    A block counts as observed when a point lies inside it or within half a block of it. Points that are not finite
    or more than 2^20 blocks away from the origin are ignored.
    """

    block_m: float
    keys: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    @classmethod
    def from_points(cls, points: NDArray[np.floating], block_m: float = 0.08) -> ObservedBlocks:
        """The blocks around surface points [N, 3] (metres, world)."""
        out = cls(block_m)
        for start in range(0, len(points), _POINTS_AT_ONCE):
            out = out.merged(points[start : start + _POINTS_AT_ONCE])
        return out

    def merged(self, points: NDArray[np.floating]) -> ObservedBlocks:
        """These blocks and those around further points [N, 3]; costs a sort of the new keys only."""
        scaled = np.asarray(points, np.float64).reshape(-1, 3) / self.block_m
        scaled = scaled[(np.abs(scaled) < _HALF - 2).all(1)]
        lowest = np.unique(pack(np.floor(scaled - 0.5).astype(np.int64)))
        around = np.unique(lowest[:, None] + shift(CORNERS))
        new = around[find(self.keys, around) == len(self.keys)]
        if not len(new):
            return self
        return ObservedBlocks(self.block_m, np.insert(self.keys, np.searchsorted(self.keys, new), new))

    def coarser(self, factor: int) -> ObservedBlocks:
        """The same place in blocks ``factor`` times as long."""
        return ObservedBlocks(self.block_m * factor, np.unique(pack(unpack(self.keys) // factor)))

    def __len__(self) -> int:
        return len(self.keys)


@dataclass(frozen=True)
class Lattice:
    """The blocks of an infinite lattice of points that marching cubes needs, EDGE^3 points each.

    Point (i, j, k) of block B lies at (EDGE * B + (i, j, k)) * voxel_m; cell (i, j, k) has it as its lowest corner.
    keys: int64 [n], sorted. upper: int64 [n, 8], row of the block at +CORNERS[c], n where it is missing. cells: bool
    [n, EDGE, EDGE, EDGE], whether the middle of a cell is observed. All blocks above an observed cell are present.
    """

    voxel_m: float
    keys: NDArray[np.int64]
    upper: NDArray[np.int64]
    cells: NDArray[np.bool_]

    @classmethod
    def covering(cls, observed: ObservedBlocks, voxel_m: float) -> Lattice:
        """All blocks that hold a corner of an observed cell."""
        observed = observed.coarser(max(1, int(np.ceil(voxel_m / observed.block_m))))
        candidates = _overlapping(observed, voxel_m)
        cells = np.concatenate(
            [np.zeros((0, EDGE, EDGE, EDGE), bool)]
            + [
                _observed_cells(part, observed, voxel_m)
                for part in np.array_split(candidates, len(candidates) // 4096 + 1)
            ]
        )
        occupied = cells.reshape(-1, EDGE**3).any(1)
        steps = shift(CORNERS)
        keys = np.unique(candidates[occupied, None] + steps)
        placed = np.zeros((len(keys), EDGE, EDGE, EDGE), bool)
        placed[find(keys, candidates[occupied])] = cells[occupied]
        return cls(voxel_m, keys, find(keys, keys[:, None] + steps), placed)

    def corners(self) -> NDArray[np.int64]:
        """Flat numbers (row * EDGE^3 + point) of all corners of observed cells, ascending."""
        needed = np.zeros((len(self.keys) + 1, EDGE, EDGE, EDGE), bool)
        for rows in np.array_split(np.arange(len(self.keys)), len(self.keys) // 4096 + 1):
            halo = np.zeros((len(rows), EDGE + 1, EDGE + 1, EDGE + 1), bool)
            for x, y, z in CORNERS:
                halo[:, x : x + EDGE, y : y + EDGE, z : z + EDGE] |= self.cells[rows]
            for corner, (inner, outer) in enumerate(_HALO):
                owner = (self.upper[rows, corner], *inner)
                needed[owner] |= halo[outer]
        return np.flatnonzero(needed[:-1])

    def points(self, flat: NDArray[np.int64]) -> NDArray[np.float32]:
        """Positions float32 [n, 3] (metres) of flat point numbers [n]."""
        row, point = np.divmod(flat, EDGE**3)
        local = np.stack(np.unravel_index(point, (EDGE, EDGE, EDGE)), -1)
        return ((unpack(self.keys[row]) * EDGE + local) * self.voxel_m).astype(np.float32)

    def with_halo(self, values: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """[len(rows), EDGE + 1, ...]: the values [n + 1, EDGE, EDGE, EDGE] of blocks and of the layer above them.

        The last row of ``values`` stands for every missing block.
        """
        out = np.empty((len(rows), EDGE + 1, EDGE + 1, EDGE + 1), values.dtype)
        for corner, (inner, outer) in enumerate(_HALO):
            owner = (self.upper[rows, corner], *inner)
            out[outer] = values[owner]
        return out


def _halo_slices(corner: NDArray[np.int64]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    inner = tuple(slice(0, 1) if up else slice(0, EDGE) for up in corner)
    outer = tuple(slice(EDGE, EDGE + 1) if up else slice(0, EDGE) for up in corner)
    return inner, (slice(None), *outer)


# For each corner c: the part of block +CORNERS[c] that an array with a halo shows, and where it shows it.
_HALO = [_halo_slices(corner) for corner in CORNERS]


def _overlapping(observed: ObservedBlocks, voxel_m: float) -> NDArray[np.int64]:
    """Keys of the lattice blocks that touch an observed block."""
    ratio = observed.block_m / (EDGE * voxel_m)
    index = unpack(observed.keys)
    low = np.floor(index * ratio).astype(np.int64)
    high = np.floor((index + 1) * ratio).astype(np.int64)
    span = int((high - low).max(initial=0)) + 1
    offsets = np.stack(np.meshgrid(*[np.arange(span)] * 3, indexing="ij"), -1).reshape(-1, 3)
    keys = [pack((low + o)[(low + o <= high).all(1)]) for o in offsets]
    return np.unique(np.concatenate(keys))


def _observed_cells(keys: NDArray[np.int64], observed: ObservedBlocks, voxel_m: float) -> NDArray[np.bool_]:
    """bool [n, EDGE, EDGE, EDGE]: whether the middle of each cell of blocks ``keys`` is observed."""
    cell = unpack(keys)[:, None] * EDGE + np.arange(EDGE)[:, None]  # [n, EDGE, 3]
    block = np.floor((cell + 0.5) * (voxel_m / observed.block_m)).astype(np.int64)
    step = block - block[:, :1]
    span = int(step.max(initial=0)) + 1
    cube = np.stack(np.meshgrid(*[np.arange(span)] * 3, indexing="ij"), -1)
    wanted = pack(block[:, 0])[:, None, None, None] + shift(cube)
    seen = find(observed.keys, wanted) < len(observed.keys)
    row = np.arange(len(keys))[:, None, None, None]
    return seen[row, step[:, :, None, None, 0], step[:, None, :, None, 1], step[:, None, None, :, 2]]
