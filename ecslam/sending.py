"""Numbers for recorded loops on a device, at fixed places: sent in one copy, or drawn many at a time."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

TURNS = 4


class Letter:
    """Numbers that the host writes and sends in one copy, which nothing waits for.

    there: float64 [count], where they arrive. Before it has been sent ``TURNS`` times more, what was sent must have
    arrived: whoever waits for a result in between has seen to that.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.there = torch.zeros(count, dtype=torch.float64, device=device)
        turns = torch.zeros(TURNS, count, dtype=torch.float64, pin_memory=device.type == "cuda")
        self._turns: list[tuple[Tensor, NDArray[np.float64]]] = [(turn, turn.numpy()) for turn in turns]

    def send(self, *parts: ArrayLike) -> Tensor:
        """Send these numbers, one array after another, which must be ``count`` in all; where they arrive."""
        self._turns.append(self._turns.pop(0))
        turn, written = self._turns[0]
        np.concatenate([np.ravel(part) for part in parts], out=written, casting="unsafe")
        return self.there.copy_(turn, non_blocking=True)


class Dice:
    """Random numbers in 0..1, a row at a time; many rows are drawn at once, on the device.

    rows: float32 [ROWS, count]. generator: on the device.
    """

    ROWS = 16

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.rows = torch.empty(self.ROWS, count, device=generator.device)
        self._generator, self._left = generator, 0

    def throw(self) -> int:
        """Which row is next."""
        if not self._left:
            torch.rand(self.rows.shape, generator=self._generator, out=self.rows)
            self._left = self.ROWS
        self._left -= 1
        return self._left
