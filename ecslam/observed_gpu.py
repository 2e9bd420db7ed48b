"""Where the map has been observed, on a GPU: asking and marking never wait."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .kernels.reference import PRIMES
from .observed import VOXEL_M, ObservedVoxels

SLOTS = 1 << 22  # of a byte; a room marks one in a hundred, so as many unobserved voxels pass


class ObservedTable:
    """``ObservedVoxels`` as a hashed table of fixed size. views: how many have been added."""

    def __init__(self, device: torch.device) -> None:
        self.views = 0
        self.marks = torch.zeros(SLOTS, dtype=torch.bool, device=device)

    def add(self, local: NDArray[np.float32], c2w: NDArray[np.float64]) -> None:
        """Mark the voxels of a view's points [N, 3], given in its camera, c2w [4, 4]."""
        self.views += 1
        points, pose = (torch.from_numpy(a).to(self.marks.device, non_blocking=True) for a in (local, c2w))
        self.marks.index_fill_(0, self._slots(points.double() @ pose[:3, :3].mT + pose[:3, 3]), True)

    def state(self) -> dict[str, NDArray[np.int64]]:
        """That of ``ObservedVoxels`` before the first view: the views are added again."""
        return ObservedVoxels().state()

    def load(self, state: dict[str, NDArray[np.int64]]) -> None:
        """Nothing: see ``state``."""

    def _slots(self, points: Tensor) -> Tensor:
        """Where the voxels of world points [N, 3] have their marks: int64 [N]."""
        cell = torch.floor(points / VOXEL_M).long()
        x, y, z = (cell[:, i] * prime for i, prime in enumerate(PRIMES))
        return (x ^ y ^ z) & (SLOTS - 1)
