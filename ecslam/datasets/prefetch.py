"""Frames read ahead by a few threads (OpenCV decodes without holding Python's lock)."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from ..types import Frame, FrameError, Sequence

MOST_WORKERS = 12


def prefetch(
    sequence: Sequence, indices: Iterable[int] | None = None, *, workers: int | None = None, ahead: int | None = None
) -> Iterator[tuple[int, Frame | FrameError]]:
    """Yield (index, frame) in the order of ``indices`` (default: all), with at most ``ahead`` frames read in advance.

    workers: threads, by default one a core within reason; ahead: by default two a worker.
    Whatever goes wrong with one frame is yielded in its place as a FrameError and the rest goes on. Closing the
    generator, or dropping it, cancels what has not begun and waits only for the reads under way.
    """
    workers = workers or min(max(os.cpu_count() or 1, 2), MOST_WORKERS)
    ahead = 2 * workers if ahead is None else ahead
    pending: deque[tuple[int, Future[Frame | FrameError]]] = deque()
    with ThreadPoolExecutor(workers, thread_name_prefix="prefetch") as pool:
        try:
            for index in range(len(sequence)) if indices is None else indices:
                pending.append((index, pool.submit(_read, sequence, index)))
                if len(pending) > ahead:
                    yield _result(pending)
            while pending:
                yield _result(pending)
        finally:
            for _, future in pending:
                future.cancel()


def _result(pending: deque[tuple[int, Future[Frame | FrameError]]]) -> tuple[int, Frame | FrameError]:
    index, future = pending.popleft()
    return index, future.result()


def _read(sequence: Sequence, index: int) -> Frame | FrameError:
    try:
        return sequence[index]
    except FrameError as error:
        return error
    except Exception as error:
        return FrameError(f"{sequence.name}: frame {index} cannot be read ({type(error).__name__}: {error})")
