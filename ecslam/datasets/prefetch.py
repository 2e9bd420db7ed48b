"""Frames read ahead, by a few threads (OpenCV decodes without holding Python's lock) or whoever else reads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Protocol

from ..cores import cores
from ..types import Frame, FrameError, Sequence

MOST_WORKERS = 12


def workers() -> int:
    """How many threads read frames: one a core, within reason."""
    return min(max(cores(), 2), MOST_WORKERS)


class Readers(Protocol):
    """Those who read frames. ahead: how many frames are best asked for in advance."""

    ahead: int

    def submit(self, index: int) -> Future[Frame | FrameError]:
        """Begin to read a frame: itself, or what is wrong with it."""
        ...

    def close(self) -> None:
        """Stop: cancel what has not begun, wait only for the reads under way."""
        ...


class ReadingThreads:
    """``Readers`` that are threads of this process."""

    def __init__(self, sequence: Sequence, prepare: Callable[[Frame], Frame], count: int) -> None:
        self.ahead = 2 * count
        self._sequence, self._prepare = sequence, prepare
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="prefetch")

    def submit(self, index: int) -> Future[Frame | FrameError]:
        """See ``Readers``."""
        return self._pool.submit(read, self._sequence, self._prepare, index)

    def close(self) -> None:
        """See ``Readers``."""
        self._pool.shutdown(cancel_futures=True)


class Prefetch(Iterator[tuple[int, Frame | FrameError]]):
    """Yields (index, frame) in the order of ``indices`` (default: all), with at most ``ahead`` frames read in advance.
    Reading begins at once.

    threads: by default ``workers()``; ahead: by default two a thread. prepare: what the same threads make of each
    frame. readers: who read instead of them.
    Whatever goes wrong with one frame is yielded in its place as a FrameError and the rest goes on. ``close``, or
    dropping the iterator, cancels what has not begun and waits only for the reads under way.
    """

    def __init__(
        self,
        sequence: Sequence,
        indices: Iterable[int] | None = None,
        *,
        threads: int | None = None,
        ahead: int | None = None,
        prepare: Callable[[Frame], Frame] = lambda frame: frame,
        readers: Readers | None = None,
    ) -> None:
        self._readers = readers or ReadingThreads(sequence, prepare, threads or workers())
        self._coming = iter(range(len(sequence)) if indices is None else indices)
        self._pending: deque[tuple[int, Future[Frame | FrameError]]] = deque()
        self._submit(self._readers.ahead if ahead is None else ahead)

    def __next__(self) -> tuple[int, Frame | FrameError]:
        self._submit(1)
        if not self._pending:
            self.close()
            raise StopIteration
        index, future = self._pending.popleft()
        return index, future.result()

    def ready(self, seconds: float) -> bool:
        """Wait until ``next`` need not wait, no longer than so; whether that is so."""
        if not self._pending:
            return True
        _, coming = self._pending[0]
        return coming.done() or bool(wait([coming], seconds).done)

    def peek(self) -> Frame | None:
        """The frame that ``next`` gives, where it has been read and is none that is left out."""
        if not self._pending or not self._pending[0][1].done():
            return None
        coming = self._pending[0][1].result()
        return coming if isinstance(coming, Frame) else None

    def close(self) -> None:
        """Stop reading; nothing more is yielded."""
        self._pending.clear()
        self._coming = iter(())
        self._readers.close()

    def __del__(self) -> None:
        self.close()

    def _submit(self, count: int) -> None:
        for index in islice(self._coming, count):
            self._pending.append((index, self._readers.submit(index)))


def read(sequence: Sequence, prepare: Callable[[Frame], Frame], index: int) -> Frame | FrameError:
    """A frame, prepared, or what is wrong with it."""
    try:
        return prepare(sequence[index])
    except FrameError as error:
        return error
    except Exception as error:
        return FrameError(f"{sequence.name}: frame {index} cannot be read ({type(error).__name__}: {error})")
