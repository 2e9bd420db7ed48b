"""Where the map has been observed: a sparse set of voxels, so that tracking never trusts an extrapolated surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BITS = 21
HALF = 1 << (BITS - 1)


class ObservedVoxels:
    """Voxels of ``voxel_m`` metres that hold at least one measured surface point."""

    def __init__(self, voxel_m: float = 0.05) -> None:
        self.voxel_m = voxel_m
        self.keys: NDArray[np.int64] = np.empty(0, np.int64)

    def _keys(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        cell = np.floor(points / self.voxel_m).astype(np.int64) + HALF
        return (cell[:, 0] << (2 * BITS)) | (cell[:, 1] << BITS) | cell[:, 2]

    def add(self, points: NDArray[np.floating]) -> None:
        """Mark the voxels of world points [N, 3]."""
        self.keys = np.union1d(self.keys, self._keys(points))

    def contains(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """bool [N]: whether each world point [N, 3] lies in a marked voxel."""
        if len(self.keys) == 0 or len(points) == 0:
            return np.zeros(len(points), bool)
        keys = self._keys(points)
        return self.keys[np.searchsorted(self.keys, keys).clip(max=len(self.keys) - 1)] == keys
