"""Where the map has been observed: a sparse set of voxels, so that tracking never trusts an extrapolated surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .pixels import Pixels

BITS = 21
HALF = 1 << (BITS - 1)
VOXEL_M = 0.05
LEAST_KNOWN = 100


class ObservedVoxels:
    """Voxels of ``VOXEL_M`` metres that hold at least one measured surface point. views: how many have been added."""

    def __init__(self) -> None:
        self.views = 0
        self.keys: NDArray[np.int64] = np.empty(0, np.int64)

    def _keys(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        cell = np.floor(points / VOXEL_M).astype(np.int64) + HALF
        return (cell[:, 0] << (2 * BITS)) | (cell[:, 1] << BITS) | cell[:, 2]

    def add(self, local: NDArray[np.float32], c2w: NDArray[np.float64]) -> None:
        """Mark the voxels of a view's points [N, 3], given in its camera, c2w [4, 4]."""
        self.views += 1
        self.keys = np.union1d(self.keys, self._keys((local @ c2w[:3, :3].T + c2w[:3, 3]).astype(np.float32)))

    def contains(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """bool [N]: whether each world point [N, 3] lies in a marked voxel."""
        if len(self.keys) == 0 or len(points) == 0:
            return np.zeros(len(points), bool)
        keys = self._keys(points)
        return self.keys[np.searchsorted(self.keys, keys).clip(max=len(self.keys) - 1)] == keys

    def known(self, pixels: Pixels, guess: NDArray[np.float64], same_count: bool) -> Pixels:
        """The pixels whose measured point, seen from ``guess`` [4, 4], lies in a marked voxel; all of them when that
        leaves too few. same_count: as many as before, some of them more than once, so that a recorded loop fits."""
        local = np.concatenate([pixels.direction, np.ones((len(pixels), 1), np.float32)], 1) * pixels.depth[:, None]
        inside = self.contains(local @ guess[:3, :3].T + guess[:3, 3]) & (pixels.depth > 0)
        index = np.flatnonzero(inside)
        if len(index) < LEAST_KNOWN:
            return pixels
        return pixels.take(np.resize(index, len(pixels)) if same_count else index)

    def state(self) -> dict[str, NDArray[np.int64]]:
        """For a checkpoint."""
        return {"keys": self.keys, "views": np.array(self.views)}

    def load(self, state: dict[str, NDArray[np.int64]]) -> None:
        """Go on from what ``state`` gave."""
        self.keys, self.views = np.array(state["keys"], np.int64), int(state["views"])
