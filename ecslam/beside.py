"""Mapping beside tracking: in a second thread, or on a GPU in a second stream."""

from __future__ import annotations

import time
import weakref
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from .mapper import Mapping, MapResult


@dataclass(frozen=True)
class Mapped:
    """A mapping that is done. window: rows [W] of the keyframes that took part."""

    window: NDArray[np.int64]
    result: MapResult


class Beside:
    """Where mappings go on while tracking does, one at a time."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._pool = None if self._stream else ThreadPoolExecutor(1, "mapper")
        if self._stream is not None:  # a map that is dropped in the middle must not be written to once others lie there
            weakref.finalize(self, self._stream.synchronize)
        self._window: NDArray[np.int64] = np.empty(0, np.int64)
        self._coming: Future[MapResult] | Mapping | None = None

    def begin(self, window: NDArray[np.int64], begin: Callable[[], Mapping]) -> None:
        """Begin the mapping of a window, when the one before has been taken."""
        self._window = window
        if self._pool is not None:
            self._coming = self._pool.submit(lambda: begin().result())
        elif self._stream is not None:
            self._stream.wait_stream(torch.cuda.current_stream(self._stream.device))
            with torch.cuda.stream(self._stream):
                self._coming = begin()

    def take(self, block: bool) -> tuple[Mapped, float] | None:
        """What was made since, where it is done, and the seconds that were waited for it; with ``block`` whenever there
        is anything."""
        coming = self._coming
        if coming is None or not (block or coming.done()):
            return None
        began, self._coming = time.perf_counter(), None
        result = coming.result()
        return Mapped(self._window, result), time.perf_counter() - began

    def close(self) -> None:
        """End the thread, where there is one."""
        if self._pool is not None:
            self._pool.shutdown()
