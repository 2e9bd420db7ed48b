"""Numbers on their way to a device and back, which nothing waits for. Recorded loops find them at fixed places."""

from __future__ import annotations

import time

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


class Since:
    """A stopwatch from when it is made to when the result of the work in between is sent for; on a GPU that is work of
    the current stream, and nothing waits."""

    def __init__(self, device: torch.device) -> None:
        self._took_s, self._began_s = 0.0, time.perf_counter()
        self._marks = [_mark(device)] if device.type == "cuda" else []

    def bring(self, result: Tensor) -> Tensor:
        """The ``result`` on the host, where it will have arrived when the work is ``done``."""
        if not self._marks:
            self._took_s = time.perf_counter() - self._began_s
            return result.cpu()
        here = torch.empty(result.shape, dtype=result.dtype, pin_memory=True).copy_(result, non_blocking=True)
        self._marks.append(_mark(result.device))
        return here

    def done(self) -> bool:
        """Whether the result has arrived."""
        return not self._marks or self._marks[-1].query()

    def seconds(self) -> float:
        """How long it took, once the result has arrived; waits for that."""
        if not self._marks:
            return self._took_s
        began, ended = self._marks
        ended.synchronize()
        return 1e-3 * began.elapsed_time(ended)


def _mark(device: torch.device) -> torch.cuda.Event:
    event = torch.cuda.Event(enable_timing=True)
    event.record(torch.cuda.current_stream(device))
    return event
