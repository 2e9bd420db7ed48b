"""Frames as a camera brings them: to keep up with it some are left out, evenly, so that none is far from the next."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from time import sleep
from typing import Protocol, runtime_checkable

import numpy as np

from ..types import Frame, FrameError, Sequence
from .prefetch import read
from .views import in_order

POLL_S = 0.002
STRIDE_S = 0.14  # between two frames at most, as long as that is enough to keep up
CATCH_UP = 12  # the most strides to be behind
LEAP_S = 1.0  # a longer stride than this is a leap for tracking in any case


class Arrivals(Protocol):
    """What has come of a sequence so far. Any thread may ask."""

    def arrived(self) -> int:
        """How many frames of the sequence there are by now."""
        ...

    def over(self) -> bool:
        """Whether no more will come; asked before ``arrived``."""
        ...


@runtime_checkable
class Live(Arrivals, Protocol):
    """A sequence whose camera is on: it grows until that is ``over``, and is like any other from then on."""

    @property
    def trouble(self) -> str:
        """Why the camera went off by itself, and what is missing of what it saw, else ""."""
        ...

    def close(self) -> None:
        """Switch the camera off and return when all that came has been saved."""
        ...


class Playback:
    """The frames of a recording arrive in the time that they were taken in, that of index ``first`` when this is first
    asked. clock: tells seconds."""

    def __init__(self, sequence: Sequence, clock: Callable[[], float], first: int = 0) -> None:
        times = sequence.timestamps()
        kept = in_order(times)
        self._due_s = np.maximum.accumulate(np.where(kept, times - times[kept][0], 0.0))
        self._clock, self._first, self._zero_s = clock, first, np.nan

    def arrived(self) -> int:
        """See ``Arrivals``."""
        now_s = self._clock()
        if np.isnan(self._zero_s):
            self._zero_s = now_s - self._due_s[min(self._first, len(self._due_s) - 1)]
        return int(np.searchsorted(self._due_s, now_s - self._zero_s, side="right"))

    def over(self) -> bool:
        """See ``Arrivals``."""
        return self.arrived() == len(self._due_s)


class KeepingUp(Iterator[tuple[int, Frame | FrameError]]):
    """Yields (index, frame) from index ``first`` on, to the last one, of what has arrived by then; waits where nothing
    new has. Reading begins when the first one is asked for, and each time goes on as the frame before is taken.

    The newest frame comes next if it is at most ``STRIDE_S`` later than the one before, else the last one that is: a
    camera is followed more surely over several short ways than over a long one, and tracking alone is fast enough to
    catch up. Whoever is more than ``CATCH_UP`` such strides behind gets longer ones, and who would get some of over
    ``LEAP_S``, as after a pause, the newest frame.

    prepare: what the thread that reads makes of each frame. A frame that cannot be read is yielded as a FrameError.
    ``close`` ends it, and waits for the read under way.
    """

    def __init__(
        self,
        sequence: Sequence,
        arrivals: Arrivals,
        first: int = 0,
        *,
        prepare: Callable[[Frame], Frame] = lambda frame: frame,
    ) -> None:
        self._sequence, self._arrivals, self._next, self._prepare = sequence, arrivals, first, prepare
        self._changed = threading.Condition()
        self._item: tuple[int, Frame | FrameError] | None = None
        self._ended = self._closed = False
        self._thread: threading.Thread | None = None

    def ready(self, seconds: float | None) -> bool:
        """Wait until ``next`` need not wait, no longer than so (None: for ever); whether that is so."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._read_on, name="keep up", daemon=True)
            self._thread.start()
        with self._changed:
            return self._changed.wait_for(lambda: self._item is not None or self._ended, seconds)

    def __next__(self) -> tuple[int, Frame | FrameError]:
        self.ready(None)
        with self._changed:
            item, self._item = self._item, None
            self._changed.notify_all()
        if item is None:
            raise StopIteration
        return item

    def peek(self) -> Frame | None:
        """The frame that ``next`` gives, where it has been read and is none that is left out."""
        item = self._item
        return item[1] if item is not None and isinstance(item[1], Frame) else None

    def close(self) -> None:
        """Stop reading; nothing more is yielded."""
        with self._changed:
            self._closed, self._item = True, None
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def _read_on(self) -> None:
        while (index := self._coming()) is not None:
            self._next = index + 1
            item = index, read(self._sequence, self._prepare, index)
            with self._changed:
                self._item = None if self._closed else item
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._item is None or self._closed)
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _coming(self) -> int | None:
        """The frame to read, once there is one that has not been; None where none will come."""
        while not self._closed:
            over, arrived = self._arrivals.over(), self._arrivals.arrived()
            if arrived > self._next:
                return self._within_reach(arrived)
            if over:
                return None
            sleep(POLL_S)
        return None

    def _within_reach(self, arrived: int) -> int:
        """The frame after the last one that was read, of those that have arrived."""
        if self._next == 0:
            return arrived - 1
        since_s = self._sequence.timestamps()[self._next - 1 : arrived]
        since_s = since_s - since_s[0]
        reach_s = max(STRIDE_S, since_s[-1] / CATCH_UP)
        if reach_s > LEAP_S:
            return arrived - 1
        return self._next - 1 + max(int(np.searchsorted(since_s, reach_s, side="right")) - 1, 1)
