"""Where a run's frames come from: all of a recording, ahead of time, or what a camera brings, keeping up with it."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from itertools import count
from typing import TYPE_CHECKING

from ..datasets import KeepingUp, Playback, Prefetch
from .ahead import preparation
from .readers import ReadingProcesses, page_lock, portable, processes

if TYPE_CHECKING:
    from .run import Run


def frames_of(run: Run) -> Prefetch | KeepingUp:
    """The frames that ``run`` has not done yet, read and prepared."""
    plan, position, made = run.plan, run.tally.position, count(len(run.tally.rows))
    sequence, asked = plan.sequence, (lambda: run.config, plan.sequence.intrinsics, plan.device)
    if run.live is None and not plan.config.realtime:
        indices, prepare = range(position, len(sequence)), preparation(*asked)
        if (sent := portable(sequence, plan.device)) is None:
            return Prefetch(sequence, indices, prepare=prepare)
        register, readers = partial(page_lock, plan.device), None
        with suppress(OSError):  # without memory to share, threads read
            readers = ReadingProcesses(sent, sequence, asked[0], prepare, processes(), register)
        return Prefetch(sequence, indices, prepare=prepare, readers=readers)
    arrivals = Playback(sequence, lambda: run.clock.seconds, position) if run.live is None else run.live
    return KeepingUp(sequence, arrivals, position, prepare=preparation(*asked, lambda _: next(made)))
