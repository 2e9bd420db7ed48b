"""Compiled loops on plain threads: they release the interpreter's lock and may be started from any thread."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numba


@cache
def _helpers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, "ecslam-render")


def spread(work: Callable[[int], None], chunks: int) -> None:
    """Call ``work(i)`` for i = 0 .. chunks - 1, once each, on this thread and as many helpers as there are cores."""
    counter = itertools.count()

    def take() -> None:
        while (i := next(counter)) < chunks:
            work(i)

    helpers = min(numba.get_num_threads(), chunks) - 1
    others = [_helpers(helpers).submit(take) for _ in range(helpers)]
    take()
    for other in others:
        if not other.cancel():  # it has begun, or finished
            other.result()
