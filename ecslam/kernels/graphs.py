"""Whole loops in one launch: a function of tensors, recorded as a CUDA graph and replayed.

Launching costs more than computing for the small kernels of a SLAM loop. A graph repeats the recorded launches with the
recorded addresses, so what is recorded must not wait for the host, must not make tensors from Python numbers on the
host, and must take the same way whatever the values.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from torch.cuda import _POOL_HANDLE as Pool

Tensors = tuple[Tensor, ...]
Capture = Callable[[Callable[[], Tensors], torch.device], tuple[Callable[[], None], Tensors]]

_recording = threading.Lock()  # torch has one stream to record in, whichever thread asks


@dataclass
class _Held:
    """What is kept for one key: objects whose addresses a graph holds and, once recorded, its inputs and outputs.
    ran: whether it has been called plainly."""

    over: tuple[object, ...]
    ran: bool = False
    inputs: Tensors = ()
    outputs: Tensors = ()
    replay: Callable[[], None] | None = None


def capture_cuda(
    function: Callable[[], Tensors], device: torch.device, pool: Pool
) -> tuple[Callable[[], None], Tensors]:
    """Record ``function`` without running it: how to replay it, and where its results then lie. pool: whose memory it
    takes (``torch.cuda.graph_pool_handle``).

    Only this thread's calls count as forbidden ones: tracking and mapping may use the device at the same time. Not by
    ``torch.cuda.graph``, which first waits for the device and empties torch's caches; others are using these.
    """
    with _recording, _nothing_collected(), torch.cuda.device(device), torch.cuda.stream(_lane(device)):
        graph = torch.cuda.CUDAGraph()
        graph.capture_begin(pool=pool, capture_error_mode="thread_local")
        try:
            outputs = function()
        finally:
            graph.capture_end()
    return graph.replay, outputs


@contextmanager
def _nothing_collected() -> Iterator[None]:
    """Meanwhile no garbage is collected: what frees memory of a device could spoil a recording."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


@cache
def _lane(device: torch.device) -> torch.cuda.Stream:
    """The stream that is recorded in, which is never the one that work is in."""
    return torch.cuda.Stream(device)


class Recorder:
    """Calls functions, and from the second call of one with the same sizes on replays it as a CUDA graph.

    The first call runs plainly, which also compiles kernels and fills caches, so nothing runs that was not asked for
    and a function may change what it holds in place. Over other objects it is recorded at once, if that is possible. If
    it is to be ``plain``, without CUDA, and once recording has failed after a plain call, every call is plain;
    ``failure`` then says why. Results are copies. ``keep`` graphs are kept, the least recently used go first. One
    thread may use it at a time, and only one of its graphs be at work: they share their memory.
    """

    def __init__(self, keep: int = 4, capture: Capture | None = None, plain: bool = False) -> None:
        self.failure = ""
        self._keep, self._capture, self._plain = keep, capture, plain
        self._held: dict[Hashable, _Held] = {}
        self._called: set[Hashable] = set()
        self._pool: Pool | None = None

    def __call__(
        self,
        function: Callable[..., Tensors],
        *inputs: Tensor,
        key: Hashable,
        over: tuple[object, ...] = (),
        device: torch.device | None = None,
        lent: bool = False,
    ) -> Tensors:
        """``function(*inputs)``.

        key: which function it is, and all the values, beside the inputs' sizes, that decide what it launches. over:
        objects with tensors that it reads or changes without being given them; another object means another graph.
        device: where it runs, if there are no inputs. lent: the results need not be copies; the next call of anything
        overwrites them.
        """
        device = device or inputs[0].device
        if self._plain or self.failure or not (self._capture or device.type == "cuda"):
            return function(*inputs)
        sizes = key, tuple((t.shape, t.dtype, t.device) for t in inputs)
        whole = sizes, tuple(map(id, over))
        held = self._held.pop(whole, None) or _Held(over)
        self._remember(whole, held)
        known = sizes in self._called
        if not known or (held.replay is None and not self._record(held, function, inputs, device)):
            self._called.add(sizes)
            held.ran = True
            return function(*inputs)
        assert held.replay is not None
        for mine, given in zip(held.inputs, inputs, strict=True):
            mine.copy_(given)
        held.replay()
        return held.outputs if lent else tuple(t.clone() for t in held.outputs)

    def forget(self) -> None:
        """Give up all graphs, and the memory that they hold."""
        self._held.clear()
        self._called.clear()

    def _remember(self, whole: Hashable, held: _Held) -> None:
        for oldest in list(self._held)[: max(0, len(self._held) + 1 - self._keep)]:
            del self._held[oldest]
        self._held[whole] = held

    def _record(self, held: _Held, function: Callable[..., Tensors], inputs: Tensors, device: torch.device) -> bool:
        mine = tuple(t.clone() for t in inputs)
        try:
            held.replay, held.outputs = (self._capture or self._capture_cuda)(lambda: function(*mine), device)
        except RuntimeError as error:
            if held.ran:
                self.failure = f"no CUDA graph: {error.__context__ or error}"
                self._held.clear()
            return False
        held.inputs = mine
        return True

    def _capture_cuda(
        self, function: Callable[[], Tensors], device: torch.device
    ) -> tuple[Callable[[], None], Tensors]:
        # torch refuses memory whose last graph has gone, and before 2.13 that in which a recording has failed.
        if self._pool is None or not any(held.replay for held in self._held.values()):
            self._pool = torch.cuda.graph_pool_handle()
        try:
            return capture_cuda(function, device, self._pool)
        except RuntimeError:
            self._pool = None
            raise
