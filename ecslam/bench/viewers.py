"""What viewers cost: the rate of one run in blocks of frames, in turn without viewers and with them."""

from __future__ import annotations

import queue
import statistics
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from time import monotonic

from rich.console import Console

from ..messages import MeshReady, Snapshot, State
from ..runtime.engine import Engine
from ..runtime.feed import FeedSubscription
from ..types import InputError
from .runs import Figures

BLOCK = 25
_OVER = (State.FINISHED, State.FAILED)


class _Ended(Exception):
    """The run is over."""


def measure(engine: Engine, crowd: Callable[[], AbstractContextManager[None]], viewers: int, pairs: int) -> Figures:
    """Run ``engine`` for ``pairs`` pairs of blocks of ``BLOCK`` frames, or to its end, and compare within the pairs.

    crowd: gives a block with that many viewers. Returns fps_alone and fps_watched, frames/s of each block, the first
    block with its initialisation left out; ratio, the median over the pairs; first_mesh_s and first_map_s,
    seconds from the engine's start to a mesh of what the camera measured and to one from the map, None where none came.
    Raises InputError for too short a run.
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
    subscription = engine.subscribe()
    pool = ThreadPoolExecutor(1)
    meshes = pool.submit(_first_meshes, subscription, monotonic())
    pool.shutdown(wait=False)
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
    finally:
        subscription.close()
    if engine.error is not None:
        raise engine.error
    if not alone:
        raise InputError(f"too short a run: give it {4 * BLOCK} frames or more")
    ratios = [b / a for a, b in zip(alone, watched, strict=True)]
    first_mesh_s, first_map_s = meshes.result()
    return {
        "viewers": viewers,
        "fps_alone": alone,
        "fps_watched": watched,
        "ratio": statistics.median(ratios),
        "first_mesh_s": first_mesh_s,
        "first_map_s": first_map_s,
    }


def print_result(result: Figures, console: Console | None = None) -> None:
    """Both medians and the ratio, on a line; when the first meshes came, on another."""
    console = console or Console()
    alone, watched = (statistics.median(result[key]) for key in ("fps_alone", "fps_watched"))
    console.print(
        f"{alone:.2f} frames/s without viewers, {watched:.2f} with {result['viewers']}: {result['ratio']:.2f} times as "
        f"many (median of {len(result['fps_alone'])} pairs of {BLOCK} frames)",
        soft_wrap=True,
        highlight=False,
    )
    if result["first_map_s"] is not None:
        console.print(
            f"first mesh {result['first_mesh_s']:.1f} s after the start, the map's own {result['first_map_s']:.1f} s",
            highlight=False,
        )


def _first_meshes(subscription: FeedSubscription, started: float) -> tuple[float | None, float | None]:
    """When the first mesh came and the first one from the map, in seconds after ``started``; None for what did not."""
    first: float | None = None
    while (message := subscription.get()) is not None:
        if isinstance(message, MeshReady):
            after = monotonic() - started
            first = first or after
            if message.voxel_m > 0:
                subscription.close()
                return first, after
    return first, None


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
