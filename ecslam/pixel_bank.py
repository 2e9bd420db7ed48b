"""The stored pixels of keyframes on a device, so that drawing rays from them never waits for the host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import torch
from numpy.typing import NDArray

from .pixels import Pixels
from .rays import DevicePixels, upload

LEAST_ROOM = 1 << 22  # more room is another place, over which loops are recorded anew


class PixelBank:
    """Holds every view it has been asked for, one after another.

    columns: pixels in tensors with room to grow; replaced by larger ones when that is used up.
    """

    def __init__(self, device: torch.device) -> None:
        self._device, self._used = device, 0
        self._held: dict[int, tuple[Pixels, int]] = {}
        self.columns = self._allocate(0)

    def spans(self, views: Sequence[Pixels]) -> NDArray[np.int64]:
        """[W, 2] first row and count of each view in ``columns``; what is not there yet is uploaded."""
        return np.array([[self._first_row(view), len(view)] for view in views], np.int64).reshape(-1, 2)

    def _first_row(self, view: Pixels) -> int:
        place = view.depth.ctypes.data  # of memory that is held here, so nothing else comes to lie there
        if place not in self._held:
            first, last = self._used, self._used + len(view)
            self._require(last)
            new = upload(view, self._device)
            for f in fields(DevicePixels):
                getattr(self.columns, f.name)[first:last] = getattr(new, f.name)
            self._held[place], self._used = (view, first), last
        return self._held[place][1]

    def _require(self, rows: int) -> None:
        if rows > len(self.columns.depth):
            old, self.columns = self.columns, self._allocate(2 * rows)
            for f in fields(DevicePixels):
                getattr(self.columns, f.name)[: self._used] = getattr(old, f.name)[: self._used]

    def _allocate(self, rows: int) -> DevicePixels:
        rows = max(rows, LEAST_ROOM)
        return DevicePixels(
            torch.zeros(rows, 3, device=self._device),
            torch.zeros(rows, device=self._device),
            torch.zeros(rows, 3, dtype=torch.uint8, device=self._device),
            torch.zeros(rows, dtype=torch.bool, device=self._device),
        )
