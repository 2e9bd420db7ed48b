"""How far the work is that has been given to a device, and how long it takes there."""

from __future__ import annotations

import time

import torch
from torch import Tensor


class Since:
    """A stopwatch from when it is made to when the result of the work in between is sent for; on a GPU that is work of
    the current stream, and nothing waits."""

    def __init__(self, device: torch.device) -> None:
        self._took_s, self._began_s = 0.0, time.perf_counter()
        self._marks = [_mark()] if device.type == "cuda" else []

    def bring(self, result: Tensor) -> Tensor:
        """The ``result`` on the host, where it will have arrived when the work is ``done``."""
        if not self._marks:
            self._took_s = time.perf_counter() - self._began_s
            return result.cpu()
        here = torch.empty(result.shape, dtype=result.dtype, pin_memory=True).copy_(result, non_blocking=True)
        self._marks.append(_mark())
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


def _mark() -> torch.cuda.Event:
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event
