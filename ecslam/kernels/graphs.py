"""Whole loops in one launch: a function of tensors, recorded as a CUDA graph and replayed.

Launching costs more than computing for the small kernels of a SLAM loop. A graph repeats the recorded launches with the
recorded addresses, so what is recorded must not wait for the host, must not make tensors from Python numbers on the
host, and must take the same way whatever the values.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

Tensors = tuple[Tensor, ...]
Capture = Callable[[Callable[[], Tensors], torch.device], tuple[Callable[[], None], Tensors]]

_recording = threading.Lock()  # torch has one stream to record in, whichever thread asks


@dataclass
class _Held:
    """What is kept for one key: objects whose addresses a graph holds and, once recorded, its inputs and outputs."""

    over: tuple[object, ...]
    inputs: Tensors = ()
    outputs: Tensors = ()
    replay: Callable[[], None] | None = None


def capture_cuda(function: Callable[[], Tensors], device: torch.device) -> tuple[Callable[[], None], Tensors]:
    """Record ``function`` without running it: how to replay it, and where its results then lie.

    Only this thread's calls count as forbidden ones: tracking and mapping may use the device at the same time. After a
    recording that fails torch stays in the stream it recorded in, so the thread's own one is taken up again here.
    """
    with _recording, torch.cuda.device(device), torch.cuda.stream(torch.cuda.current_stream(device)):
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            outputs = function()
    return graph.replay, outputs


class Recorder:
    """Calls functions, and from the second call of one with the same sizes on replays it as a CUDA graph.

    The first call runs plainly, which also compiles kernels and fills caches, so nothing runs that was not asked for
    and a function may change what it holds in place. If it is to be ``plain``, without CUDA, and once recording has
    failed, every call is plain; ``failure`` then says why. Results are copies. ``keep`` graphs are kept, the least
    recently used go first. One thread may use it at a time.
    """

    def __init__(self, keep: int = 4, capture: Capture | None = None, plain: bool = False) -> None:
        self.failure = ""
        self._keep, self._capture, self._plain = keep, capture, plain
        self._held: dict[Hashable, _Held] = {}

    def __call__(
        self, function: Callable[..., Tensors], *inputs: Tensor, key: Hashable, over: tuple[object, ...] = ()
    ) -> Tensors:
        """``function(*inputs)``, with at least one input.

        key: which function it is, and all the values, beside the inputs' sizes, that decide what it launches. over:
        objects with tensors that it reads or changes without being given them; another object means another graph.
        """
        device = inputs[0].device
        if self._plain or self.failure or not (self._capture or device.type == "cuda"):
            return function(*inputs)
        sizes = tuple((t.shape, t.dtype, t.device) for t in inputs)
        whole = (key, sizes, tuple(id(held) for held in over))
        held = self._held.pop(whole, None)
        if held is None:
            self._remember(whole, _Held(over))
            return function(*inputs)
        self._remember(whole, held)
        if held.replay is None and not self._record(held, function, inputs, device):
            return function(*inputs)
        assert held.replay is not None
        for mine, given in zip(held.inputs, inputs, strict=True):
            mine.copy_(given)
        held.replay()
        return tuple(t.clone() for t in held.outputs)

    def forget(self) -> None:
        """Give up all graphs, and the memory that they hold."""
        self._held.clear()

    def _remember(self, whole: Hashable, held: _Held) -> None:
        for oldest in list(self._held)[: max(0, len(self._held) + 1 - self._keep)]:
            del self._held[oldest]
        self._held[whole] = held

    def _record(self, held: _Held, function: Callable[..., Tensors], inputs: Tensors, device: torch.device) -> bool:
        mine = tuple(t.clone() for t in inputs)
        try:
            held.replay, held.outputs = (self._capture or capture_cuda)(lambda: function(*mine), device)
        except RuntimeError as error:
            self.failure = f"no CUDA graph: {error}"
            self._held.clear()
            return False
        held.inputs = mine
        return True
