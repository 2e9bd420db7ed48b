"""What viewers cost: the rate of one run in blocks of frames, in turn without viewers and with them."""

from __future__ import annotations

import queue
import statistics
from collections.abc import Callable
from contextlib import AbstractContextManager
from time import monotonic

from rich.console import Console

from ..messages import Snapshot, State
from ..runtime.engine import Engine
from ..types import InputError
from .runs import Figures

BLOCK = 25
_OVER = (State.FINISHED, State.FAILED)


class _Ended(Exception):
    """The run is over."""


def measure(engine: Engine, crowd: Callable[[], AbstractContextManager[None]], viewers: int, pairs: int) -> Figures:
    """Run ``engine`` for ``pairs`` pairs of blocks of ``BLOCK`` frames, or to its end, and compare within the pairs.

    crowd: gives a block with that many viewers. Returns fps_alone and fps_watched, frames/s of each block, the first
    block with its initialisation left out; ratio, the median over the pairs. Raises InputError for too short a run.
    """
    frames: queue.SimpleQueue[tuple[int, float] | None] = queue.SimpleQueue()
    last = -1

    def watch(s: Snapshot) -> None:
        nonlocal last
        if s.state in _OVER:
            frames.put(None)
        elif s.frame > last:
            last = s.frame
            frames.put((s.frame, monotonic()))

    alone: list[float] = []
    watched: list[float] = []
    engine.start(watch)
    try:
        _rate(frames)
        while len(alone) < pairs:
            before = _rate(frames)
            with crowd():
                watched.append(_rate(frames))
            alone.append(before)
    except _Ended:
        pass
    if engine.error is not None:
        raise engine.error
    if not alone:
        raise InputError(f"too short a run: give it {4 * BLOCK} frames or more")
    ratios = [b / a for a, b in zip(alone, watched, strict=True)]
    return {"viewers": viewers, "fps_alone": alone, "fps_watched": watched, "ratio": statistics.median(ratios)}


def print_result(result: Figures, console: Console | None = None) -> None:
    """Both medians and the ratio, on a line."""
    alone, watched = (statistics.median(result[key]) for key in ("fps_alone", "fps_watched"))
    (console or Console()).print(
        f"{alone:.2f} frames/s without viewers, {watched:.2f} with {result['viewers']}: {result['ratio']:.2f} times as "
        f"many (median of {len(result['fps_alone'])} pairs of {BLOCK} frames)",
        soft_wrap=True,
        highlight=False,
    )


def _rate(frames: queue.SimpleQueue[tuple[int, float] | None]) -> float:
    """Frames per second over the next ``BLOCK`` frames; those that came before do not count."""
    while not frames.empty():
        _next(frames)
    first, began = _next(frames)
    while True:
        frame, now = _next(frames)
        if frame >= first + BLOCK:
            return (frame - first) / (now - began)


def _next(frames: queue.SimpleQueue[tuple[int, float] | None]) -> tuple[int, float]:
    """The frame that comes next and when it came. Raises _Ended."""
    item = frames.get()
    if item is None:
        raise _Ended
    return item
