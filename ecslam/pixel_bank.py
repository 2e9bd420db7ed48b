"""The stored pixels of keyframes on a device, so that drawing rays from them never waits for the host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from .kernels import DevicePixels
from .pixels import Pixels

LEAST_ROOM = 1 << 22  # more room is another place, over which loops are recorded anew


@dataclass(frozen=True)
class Place:
    """Where the pixels of a view lie: from the row ``first`` on. missing: whether some of them have no depth."""

    view: Pixels
    first: int
    missing: bool


class PixelBank:
    """Holds every view it has been asked for, one after another.

    columns: pixels in tensors with room to grow; replaced by larger ones when that is used up.
    """

    def __init__(self, device: torch.device) -> None:
        self._device, self._used = device, 0
        self._places: dict[int, Place] = {}
        self.columns = self._allocate(0)

    def places(self, views: Sequence[Pixels]) -> list[Place]:
        """Where each view lies in ``columns``; what is not there yet is uploaded."""
        return [self._place(view) for view in views]

    def _place(self, view: Pixels) -> Place:
        # The address of memory that is held here from now on, so nothing else comes to lie there.
        key = view.depth.__array_interface__["data"][0]
        if key not in self._places:
            first, last = self._used, self._used + len(view)
            self._require(last)
            given: tuple[NDArray[Any], ...] = view.direction, view.depth, view.color, view.feature
            held = self.columns
            columns = (held.direction[:, :2], held.depth, held.color, held.feature)
            for column, new in zip(columns, given, strict=True):
                column[first:last].copy_(self._ready(new), non_blocking=True)
            self._places[key], self._used = Place(view, first, bool((view.depth <= 0).any())), last
        return self._places[key]

    def _ready(self, given: NDArray[Any]) -> Tensor:
        """The same numbers, where a GPU fetches them by itself: the host would wait for what it is at before."""
        numbers = torch.from_numpy(given)
        return numbers.pin_memory() if self._device.type == "cuda" else numbers

    def _require(self, rows: int) -> None:
        if rows > len(self.columns.depth):
            old, self.columns = self.columns, self._allocate(2 * rows)
            for column, held in zip(self.columns, old, strict=True):
                column[: self._used] = held[: self._used]

    def _allocate(self, rows: int) -> DevicePixels:
        rows = max(rows, LEAST_ROOM)
        return DevicePixels(
            torch.ones(rows, 3, device=self._device),
            torch.zeros(rows, device=self._device),
            torch.zeros(rows, 3, dtype=torch.uint8, device=self._device),
            torch.zeros(rows, dtype=torch.bool, device=self._device),
        )
